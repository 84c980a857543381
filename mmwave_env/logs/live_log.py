"""Measurement logs that arrive row by row; every epoch is returned as soon as it is complete.

A row whose cells are well within their limits passes quick checks. All other rows need the full
checks of ``log_checks.py``, which are slower and also find out what is wrong.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf, isnan, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.logs.log import Log, layout_of, log_of, places
from mmwave_env.logs.log_checks import first_damage, without_lost
from mmwave_env.logs.log_columns import BODY, LOST, QUANTITIES, STATION
from mmwave_env.logs.log_tables import LogError, Table, log_file, parse
from mmwave_env.models import envelope
from mmwave_env.models.layout import Layout, wrapped
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI

_NUMBERS = {float, int, np.float64}  # types that need no parsing; others are parsed as text
_LOST = {-1.0, *LOST, *(-code for code in LOST)}  # numbers that need the full checks
_SHORTEST_S = envelope.STEP_S.least or 0.0
_LATE = 3  # number of late epochs, one after the other, with which a log goes on


class LiveEpoch(NamedTuple):
    """An epoch of a live log."""

    time_s: float
    layout: Layout
    log: Callable[[], Log]  # returns the epoch as a log, T = 1
    # None if some angles are not in the map's frame. Otherwise a pair: all values in the order of
    # :func:`~mmwave_env.logs.log.places` (NaN where not measured), and the index, from 0, of the
    # anchor with the Doppler shift
    placed: tuple[list[float], int] | None


class LiveLog:
    """A collector that groups the rows of a log into epochs as the rows arrive.

    An epoch is over when every anchor has a row, when a row with a later time arrives, or when
    :meth:`end_epoch` is called. Only the rows of two epochs are kept in memory.

    Rows that are late are refused; but if they keep coming, with increasing times, a clock was set
    back, or one row had a time in the future: then the log goes on at the earlier time. A row of
    values by column may have a column that no row had before. Columns with unknown names are
    ignored, and the first row with one adds a warning.

    Args:
        names: names of the columns, as in the header of a log.
        scene, snr_db, clock: same as for :func:`~mmwave_env.logs.log.read_log`.
        source: name of the source, for messages.
        delimiter: character between the cells of a row that is text.

    Attributes:
        warnings: what was ignored; the caller shows and clears them.
        left_out: number of values that were left out, by the name of their column, and of
            "repeated rows"; the first of each causes a warning.

    Raises:
        LogError: a column is wrong or missing, or the noise of a quantity is unknown.
    """

    def __init__(
        self,
        names: Sequence[str],
        scene: Scene,
        snr_db: float | None = None,
        source: str = "rows",
        clock: bool = False,
        delimiter: str = ",",
    ) -> None:
        self._source = Path(source)
        self._delimiter = delimiter
        self._scene = scene
        self._snr_db = snr_db
        self._clock = clock
        self.warnings: list[str] = []
        self.left_out: Counter[str] = Counter()
        self._ignored = {""}
        self._rows: list[list[float]] = []
        self._last: list[list[float]] = []  # rows of the last epoch
        self._last_s = -inf
        self._late_s: list[float] = []  # increasing times of late rows, with no other row between
        self._set_columns(names)

    def _set_columns(self, names: Sequence[str]) -> None:
        """Set the names of the columns, in any order; refuse wrong ones."""
        scene = self._scene
        log = log_file(self._source, names, self._delimiter, scene.hz_per_mps, partial=True)
        self.layout = layout_of(log, scene, True, self._clock, self._snr_db)
        self._log = log
        self._names = [*names]
        columns = self._log.columns
        self._turned = STATION in columns or BODY in columns
        cell_of = {of: i for i, of in enumerate(columns)}
        self._time = cell_of["time"]
        self._anchor = cell_of["anchor"]
        self._slots = [
            (cell_of[of], *place, columns[of].unit.convert, place[0] in self.layout.angles)
            for of, place in places(self.layout).items()
            if of in columns
        ]
        snr = [nan if self._snr_db is None else self._snr_db] * self.layout.anchors
        self._blank = [nan] * 2 * self.layout.size + snr + [nan]
        self._limits = {column.name: (column.low, column.high) for column in columns.values()}
        self._anchors = set(range(1, self.layout.anchors + 1))
        self._of_epoch = [
            (i, of == "doppler")
            for of, i in cell_of.items()
            if QUANTITIES[of].per_epoch or of == "doppler"
        ]

    def add(self, row: str | Mapping[str, Any], number: int = 0) -> list[LiveEpoch]:
        """Add a row: a line of CSV, or values by column; return the epochs that are now over.

        Error messages contain ``number``, the number of the row in the source.

        Raises:
            LogError: the row is damaged or late; it is ignored.
        """
        cells = self._cells(row, number)
        if not cells:
            return []
        over = []
        if not self._rows or cells[self._time] != self._rows[0][self._time]:
            time_s = self._time_s(cells)
            latest_s = self._time_s(self._rows[0]) if self._rows else self._last_s
            is_late = time_s - latest_s < _SHORTEST_S
            if is_late and self._repeats(cells, self._last, number):
                return []
            if is_late and not self._goes_on_at(time_s):
                problem = f"time {time_s!r} s in a row that follows the epoch at {latest_s!r} s"
                expected = f"times that increase by at least {_SHORTEST_S:g} s"
                raise self._log.error(number, "time", problem, expected)
            over = self.end_epoch()
        self._late_s.clear()
        for before in self._rows:
            if not self._agree(cells, before):
                if self._repeats(cells, [before], number):
                    return over
                self._require_sound(self._table([*self._rows, cells], number))
        self._rows.append(cells)
        return [*over, *(self.end_epoch() if len(self._rows) == self.layout.anchors else [])]

    def _repeats(self, cells: list[float], rows: list[list[float]], number: int) -> bool:
        """Tell whether one of these rows has the same cells; count and report repeated rows."""
        if repr(cells) not in map(repr, rows):
            return False
        self._report("repeated rows", f"repeated rows ({self._log.place(number)})")
        return True

    def _report(self, name: str, note: str) -> None:
        """Count what was left out; the first of each name causes a warning."""
        self.left_out[name] += 1
        if self.left_out[name] == 1:
            self.warnings.append(f"left out: {note}")

    def _goes_on_at(self, time_s: float) -> bool:
        """Tell whether so many late rows came in order that the log goes on at their time."""
        if not self._late_s or time_s > self._late_s[-1]:
            self._late_s.append(time_s)
        elif time_s < self._late_s[-1]:
            self._late_s = [time_s]
        if len(self._late_s) < _LATE:
            return False
        self._rows = []
        return True

    def add_epoch(self, rows: Iterable[str | Mapping[str, Any]]) -> list[LiveEpoch]:
        """Add all rows of an epoch, end it, and return the epochs that are now over.

        Raises:
            LogError: a row is damaged or late; all these rows are ignored.
        """
        rows = list(rows)
        for row in rows:
            self._learn_from(row, 0)
        before = self._rows.copy(), self._last_s
        try:
            over = [epoch for row in rows for epoch in self.add(row)]
        except LogError:
            self._rows, self._last_s = before
            raise
        return [*over, *self.end_epoch()]

    def end_epoch(self) -> list[LiveEpoch]:
        """End the current epoch; return a list with this epoch, or [] if it has no rows yet."""
        if not self._rows:
            return []
        self._last_s = self._time_s(self._rows[0])
        rows = self._rows
        self._rows = []
        self._last = rows

        def log() -> Log:
            return log_of(self._table(rows), self._scene, self.layout, True, self._snr_db)

        placed = None if self._turned else self._placed(rows)
        return [LiveEpoch(self._last_s, self.layout, log, placed)]

    def _table(self, rows: list[list[float]], number: int = 0) -> Table:
        """Return rows of cells as a table; ``number`` is the last row's number in the source."""
        return Table(self._log, np.full(len(rows), number), np.array(rows, float))

    def _placed(self, rows: list[list[float]]) -> tuple[list[float], int]:
        """Return ``placed`` of a :class:`LiveEpoch`, from the cells of its rows."""
        placed = self._blank.copy()
        doppler_anchor = 0
        doppler = self.layout.doppler
        for cells in rows:
            anchor = int(cells[self._anchor]) - 1
            for i, first, step, convert, is_angle in self._slots:
                cell = cells[i]
                place = first + step * anchor
                if not isnan(cell) and (step or isnan(placed[place])):
                    number = convert(cell)
                    turned = is_angle and not -PI <= number < PI
                    placed[place] = wrapped(number) if turned else number
                    if first == doppler:
                        doppler_anchor = anchor
        return placed, doppler_anchor

    def _time_s(self, cells: list[float]) -> float:
        return float(self._log.columns["time"].unit.convert(cells[self._time]))

    def _agree(self, cells: list[float], before: list[float]) -> bool:
        """Tell whether two rows surely fit into one epoch; if not, they need the full checks."""
        for i, once in self._of_epoch:
            a = cells[i]
            b = before[i]
            if not isnan(a) and not isnan(b) and (once or a != b):
                return False
        return cells[self._anchor] != before[self._anchor]

    def _cells(self, row: str | Mapping[str, Any], number: int) -> list[float]:
        """Return the cells of a row, or no cells for a blank line; refuse a damaged row."""
        if not isinstance(row, str):
            self._learn_from(row, number)
            cells = [nan if (cell := row.get(name)) is None else cell for name in self._limits]
            if self._plain(cells):
                return cells
            words = [
                "" if (cell := row.get(name)) is None else f'"{cell!s}"' for name in self._names
            ]
            row = self._delimiter.join(words)
        table = parse(self._log, [row], number)
        cells = table.cells.ravel().tolist()
        if cells and (table.damage or not self._plain(cells)):
            table, notes = without_lost(table, self.layout)
            self._require_sound(table)
            for name, note in notes.items():
                self._report(name, note)
        return table.cells.ravel().tolist()

    def _learn_from(self, row: str | Mapping[str, Any], number: int) -> None:
        """Add the columns of a row that no row had before."""
        if isinstance(row, str):
            return
        new = [name for name in row if name not in self._limits and name not in self._ignored]
        if new:
            self._learn(new, number)

    def _learn(self, names: list[str], number: int) -> None:
        """Add columns; ignore those that are unknown from now on."""
        known = [dict(zip(self._limits, cells, strict=True)) for cells in self._rows]
        try:
            self._set_columns([*self._names, *names])
        except LogError as error:
            if len(names) == 1:
                self._ignored.add(names[0])
                self.warnings.append(f"row {number}, column {names[0]!r} is ignored: {error}")
            for name in names if len(names) > 1 else ():
                self._learn([name], number)
            return
        self._rows = [[row.get(column, nan) for column in self._limits] for row in known]

    def _plain(self, cells: list[Any]) -> bool:
        """Tell whether the cells of a row are surely sound; if not, they need the full checks."""
        for cell, (low, high) in zip(cells, self._limits.values(), strict=True):
            # NaN is an empty cell
            if type(cell) not in _NUMBERS or cell < low or cell > high or cell in _LOST:
                return False
        return cells[self._anchor] in self._anchors and not isnan(cells[self._time])

    def _require_sound(self, table: Table) -> None:
        _, damage = first_damage(table, self.layout, limits=True)
        if damage:
            raise damage
