"""Measurement logs that arrive row by row; every epoch is returned as soon as it is complete."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmwave_env.logs.log import LogBlock, block_of, require_noise
from mmwave_env.logs.log_checks import first_damage
from mmwave_env.logs.log_columns import columns_of
from mmwave_env.logs.log_tables import LogError, LogFile, Table, parse_carefully
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import Scene


class LiveLog:
    """A collector of the rows of a log, which groups them into epochs as they arrive.

    An epoch is over when every anchor has a row, when a row with a later time arrives, or when
    :meth:`end_epoch` is called. Only the rows of one epoch are kept in memory.

    Args:
        names: names of the columns, as in the header of a log.
        scene: scene whose anchors are measured.
        snr_db: SNR to assume for links without one.
        source: name of the source, for messages.

    Raises:
        LogError: the columns are not those of a log, or do not say how large the noise is.
    """

    def __init__(
        self, names: Sequence[str], scene: Scene, snr_db: float | None = None, source: str = "rows"
    ) -> None:
        try:
            columns = columns_of(names, scene.hz_per_mps, partial=True)
        except ValueError as error:
            raise LogError(f"{source}: {error}") from error
        self._log = LogFile(Path(source), columns, len(names))
        if snr_db is None:
            require_noise(self._log)
        self._names, self._scene, self._snr_db = tuple(names), scene, snr_db
        self.layout = Layout(len(scene.anchors_m), "speed" in columns, partial=True)
        self._rows: list[Table] = []
        self._last_s = -np.inf

    def add(self, row: str | Mapping[str, Any], number: int = 0) -> list[LogBlock]:
        """Add a row; return the epochs that are over now.

        Args:
            row: a line of CSV, or a mapping from names of columns to values.
            number: number of the row in its source, for messages.

        Raises:
            LogError: the row is damaged or late, and is ignored.
        """
        if not isinstance(row, str):
            for name in row:
                if name not in self._names:
                    raise LogError(
                        f"{self._log.path}, row {number}, column {name!r}: "
                        f"found an unknown column, expected one of {', '.join(self._names)}"
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
        if damage:  # the row contradicts earlier rows of its epoch
            raise damage
        self._rows = [both]
        return [*over, *(self.end_epoch() if len(both) == anchors else [])]

    def end_epoch(self) -> list[LogBlock]:
        """End the current epoch and return it; return nothing if it has no rows yet."""
        if not self._rows:
            return []
        (rows,), self._rows = self._rows, []
        self._last_s = float(rows["time"][0])
        return [block_of(rows, self._scene, self.layout, True, self._snr_db)]
