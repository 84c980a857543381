"""A measurement log that arrives row by row; whole epochs leave at once."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmwave_env.logs.log import LogBlock, block_of, require_noise, with_clock
from mmwave_env.logs.log_checks import first_damage
from mmwave_env.logs.log_columns import columns_of
from mmwave_env.logs.log_tables import LogError, LogFile, Table, parse_carefully
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import Scene


class LiveLog:
    """The rows of a log as they arrive, gathered to epochs.

    An epoch is over when a row of each anchor is there, when a row with a later time arrives, or by
    :meth:`end_epoch`. Memory holds the rows of one epoch.

    Args:
        names: names of the columns, as in the header of a log.
        scene: scene whose anchors are measured.
        snr_db: SNR of links without one.
        source: name of the source, for messages.
        clock: whether the user's clock has an offset.

    Raises:
        LogError: the columns are not those of a log, or do not state the noise.
    """

    def __init__(
        self,
        names: Sequence[str],
        scene: Scene,
        snr_db: float | None = None,
        source: str = "rows",
        clock: bool = False,
    ) -> None:
        try:
            columns = columns_of(names, scene.hz_per_mps, partial=True)
        except ValueError as error:
            raise LogError(f"{source}: {error}") from error
        self._log = LogFile(Path(source), columns, len(names))
        if snr_db is None:
            require_noise(self._log)
        if clock:
            self._log = with_clock(self._log)
        self._names, self._scene, self._snr_db = tuple(names), scene, snr_db
        self.layout = Layout(len(scene.anchors_m), "speed" in columns, True, clock)
        self._rows: list[Table] = []
        self._last_s = -np.inf

    def add(self, row: str | Mapping[str, Any], number: int = 0) -> list[LogBlock]:
        """Take a row, as a line of CSV or by the names of columns; return the epochs that are over.

        Args:
            row: the row; an epoch's first row ends the epoch before.
            number: number of the row in its source, for messages.

        Raises:
            LogError: the row is damaged, or late; it is left out.
        """
        if not isinstance(row, str):
            for name in row:
                if name not in self._names:
                    raise LogError(
                        f"{self._log.path}, row {number}, column {name!r}: found a new column, "
                        f"expected one of {', '.join(self._names)}"
                    )
            cells = (row.get(name) for name in self._names)
            row = ",".join("" if cell is None else str(cell) for cell in cells)
        table = parse_carefully(self._log, [row], number, 0.0)
        if not len(table):
            return self.end_epoch()
        anchors = self.layout.anchors
        _, damage = first_damage(self._log, table, anchors, limits=True)
        if damage:
            raise damage
        time_s = float(table["time"][0])
        if time_s <= self._last_s:
            problem = f"{time_s:g} s after the epoch of {self._last_s:g} s was over"
            raise self._log.error(number, "time", problem, "times that increase")
        over = []
        if self._rows and time_s != self._rows[0]["time"][0]:
            if time_s < self._rows[0]["time"][0]:
                problem = f"{time_s:g} s within the epoch of {self._rows[0]['time'][0]:g} s"
                raise self._log.error(number, "time", problem, "times that increase")
            over = self.end_epoch()
        both = Table.joined([*self._rows, table])
        _, damage = first_damage(self._log, both, anchors, limits=True)
        if damage:  # it contradicts the rows before
            raise damage
        self._rows = [both]
        return [*over, *(self.end_epoch() if len(both) == anchors else [])]

    def end_epoch(self) -> list[LogBlock]:
        """Return the epoch whose rows are there, as if it were over; nothing without rows."""
        if not self._rows:
            return []
        (rows,), self._rows = self._rows, []
        self._last_s = float(rows["time"][0])
        return [block_of(rows, self._scene, self.layout, True, self._snr_db)]
