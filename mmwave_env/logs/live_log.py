"""Measurement logs that arrive row by row; every epoch is returned as soon as it is complete.

A row whose cells are well within their limits passes quick checks. All other rows need the full
checks of ``log_checks.py``, which are slower and also find out what is wrong.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from math import inf, isnan, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.logs.log import STEEP_RAD, Log, PathLog, log_of, paths_of, places
from mmwave_env.logs.log_checks import MOST_PATHS, first_damage, without_lost
from mmwave_env.logs.log_columns import (
    BODY,
    LOST,
    ODOMETRY_QUANTITIES,
    QUANTITIES,
    QUANTITY_OF,
    STATION,
    USER,
)
from mmwave_env.logs.log_tables import LogError, LogFile, Table, log_file, parse, words_of
from mmwave_env.models import envelope
from mmwave_env.models.layout import Layout, wrapped
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI

Cells = list[float]  # of a row, as in the file, NaN where empty, in the order of the columns
Row = Mapping[str, Any]  # values of a row by column

_NUMBERS = {float, int, np.float64}  # types that need no parsing; others are parsed as text
_LOST = {-1.0, *LOST, *(-code for code in LOST)}  # numbers that need the full checks
_SHORTEST_S = envelope.STEP_S.least or 0.0
_MOST_INCOMPLETE = 60  # first rows that may lack columns before the log is refused
_LATE = 3  # number of late epochs, one after the other, with which a log goes on


class LiveColumns:
    """The columns of live rows, with quick checks and conversions of rows that have them.

    Args:
        file: the description of the rows, as of a log file.
    """

    def __init__(self, file: LogFile) -> None:
        self.file = file
        columns = file.columns
        scene = file.scene
        layout = file.layout
        corrected = bool(scene.bearing_deg or scene.range_offset_m or scene.range_offset_sigma_m)
        turned = STATION in columns or BODY in columns
        self._is_quick = file.associated and not corrected and not turned
        self.most_rows = layout.anchors if file.associated else MOST_PATHS
        cell_of = {quantity: i for i, quantity in enumerate(columns)}
        self.names = [column.name for column in columns.values()]
        self.time = cell_of["time"]
        self._anchor = cell_of.get("anchor", -1)
        self._anchors = set(range(1, layout.anchors + 1))
        self._limits = [(column.low, column.high) for column in columns.values()]
        self._of_epoch = [
            (i, quantity == "doppler")
            for quantity, i in cell_of.items()
            if QUANTITIES[quantity].per_epoch or (quantity == "doppler" and file.associated)
        ]
        self._slots = [
            (cell_of[quantity], *place, columns[quantity].unit.convert, place[0] in layout.angles)
            for quantity, place in places(layout).items()
            if quantity in columns
        ]
        snr = [nan if file.snr_db is None else file.snr_db] * layout.anchors
        self._blank = [nan] * 2 * layout.size + snr + [nan]

    def are_plain(self, cells: list[Any]) -> bool:
        """Tell whether the cells of a row are surely sound; if not, they need the full checks."""
        for cell, (low, high) in zip(cells, self._limits, strict=True):
            # NaN is an empty cell
            if type(cell) not in _NUMBERS or cell < low or cell > high or cell in _LOST:
                return False
        known = not self.file.associated or cells[self._anchor] in self._anchors
        return known and not isnan(cells[self.time])

    def agree(self, cells: Cells, before: Cells) -> bool:
        """Tell whether two rows surely fit into one epoch; if not, they need the full checks."""
        for i, once in self._of_epoch:
            a = cells[i]
            b = before[i]
            if not isnan(a) and not isnan(b) and (once or a != b):
                return False
        return not self.file.associated or cells[self._anchor] != before[self._anchor]

    def time_s(self, cells: Cells) -> float:
        """Return the time of a row."""
        return float(self.file.columns["time"].unit.convert(cells[self.time]))

    def table(self, epochs: list[list[Cells]], number: int = 0) -> Table:
        """Return the rows of epochs as a table; ``number`` is that of the rows in the source."""
        rows = [row for rows in epochs for row in rows]
        epoch_of_row = np.repeat(np.arange(len(epochs)), list(map(len, epochs)))
        numbers = np.full(len(rows), number)
        return Table(self.file, numbers, np.array(rows, float), epoch_of_row=epoch_of_row)

    def placed(self, rows: list[Cells]) -> tuple[list[float], int] | None:
        """Return all values of an epoch, and the index of the anchor with the Doppler shift.

        Values are in the order of :func:`~mmwave_env.logs.log.places`, NaN where not measured;
        anchors are counted from 0. The result is None if some angles are not in the map's frame, or
        are steep, or if the scene corrects measurements.
        """
        if not self._is_quick:
            return None
        placed = self._blank.copy()
        doppler = self.file.layout.doppler
        doppler_anchor = 0
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
        if any(abs(elevation) > STEEP_RAD for elevation in placed[2:doppler:4]):
            return None
        return placed, doppler_anchor


class LiveEpoch(NamedTuple):
    """An epoch of a live log."""

    user: str  # the cell ``ue`` of its rows; "" without such a column
    time_s: float
    rows: list[Cells]
    columns: LiveColumns

    @property
    def layout(self) -> Layout:
        """Return the layout of the epoch's values."""
        return self.columns.file.layout

    def paths(self) -> PathLog:
        """Return the epoch, whose rows are paths, as a log."""
        return paths_of(self.columns.table([self.rows]))


def log_from(epochs: Iterable[LiveEpoch]) -> Log:
    """Return epochs of a user, or an epoch of each of T users, as a log without steep angles.

    The times of users need not increase.
    """
    log: Log = Log.joined(
        [
            log_of(columns.table([epoch.rows for epoch in some]))
            for columns, some in groupby(epochs, key=lambda epoch: epoch.columns)
        ]
    )
    return log.without_steep_angles()


@dataclass(slots=True)
class _Arrivals:
    """The rows that have arrived from a user."""

    rows: list[Cells] = field(default_factory=list)  # of the current epoch
    last: list[Cells] = field(default_factory=list)  # rows of the last epoch
    late_s: list[float] = field(default_factory=list)  # increasing times of the latest, late rows

    def goes_on_at(self, time_s: float) -> bool:
        """Tell whether so many late rows came in order that the log goes on at their time."""
        if self.late_s and time_s < self.late_s[-1]:
            self.late_s.clear()
        if not self.late_s or time_s > self.late_s[-1]:
            self.late_s.append(time_s)
        if len(self.late_s) < _LATE:
            return False
        self.rows = []
        return True


class LiveLog:
    """A collector that groups the rows of a log into epochs as the rows arrive.

    An epoch is over when every anchor has a row, when a row with a later time arrives, or when
    :meth:`end_epoch` is called. Only the rows of two epochs are kept in memory. Rows may have a
    column ``ue``, any text, which names the user; each user has epochs of its own.

    Rows that are late are refused; but if they keep coming, with increasing times, a clock was set
    back, or one row had a time in the future: then the log goes on at the earlier time. A row of
    values by column may have a column that no row had before. Columns with unknown names are
    ignored, and the first row with one adds a warning.

    If rows are paths without anchor numbers, every epoch ends with a row of a later time.

    Args:
        names: names of the columns, as in the header of a log. Rows of values by column need none:
            the log begins with the columns of as many rows as it needs.
        scene, snr_db, clock: same as for :func:`~mmwave_env.logs.log.read_log`.
        source: name of the source, for messages.
        delimiter: character between the cells of a row that is text.
        associated: whether rows have anchor numbers; if False, they are ignored.

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
        clock: str = "synchronized",
        delimiter: str = ",",
        associated: bool = True,
    ) -> None:
        self.warnings: list[str] = []
        self.left_out = Counter[str]()
        self._arrivals = defaultdict[str, _Arrivals](_Arrivals)  # by user
        self._user = names.index(USER) if USER in names else None
        self._known = {"", USER, *names}  # also names of columns that are ignored
        self._waiting: list[str] = []  # columns that are ignored without others
        self._rows: list[tuple[str | Row, int]] = []  # that are not added yet
        self._problem: LogError | None = None  # why the first rows are no log
        self._file = partial(
            log_file, Path(source), delimiter=delimiter, scene=scene, snr_db=snr_db, clock=clock,
            associated=associated,
        )  # fmt: skip
        self._is_open = bool(names)  # whether the columns of the log are known
        if names:
            self._columns = LiveColumns(self._file([name for name in names if name != USER]))

    def add(self, row: str | Row, number: int = 0) -> list[LiveEpoch]:
        """Add a row: a line of CSV, or values by column; return the epochs that are now over.

        Error messages contain ``number``, the number of the row in the source.

        Raises:
            LogError: the row is damaged or late; it is ignored.
            ValueError: too many first rows lack columns that a log needs.
        """
        if not isinstance(row, str):
            self._learn(row, number)
        self._rows.append((row, number))
        if not self._is_open:
            if len(self._rows) >= _MOST_INCOMPLETE:
                raise ValueError(self._problem)
            return []
        return self._caught_up()

    def _caught_up(self) -> list[LiveEpoch]:
        """Add the rows that wait; return the epochs that are now over."""
        over = []
        while self._rows:
            over += self._added(*self._rows.pop(0))
        return over

    def _added(self, row: str | Row, number: int) -> list[LiveEpoch]:
        """Add a row of a log whose columns are known; otherwise the same as :meth:`add`."""
        user, cells = self._cells(row, number)
        if not cells:
            return []
        arrived = self._arrivals[user]
        columns = self._columns
        over = []
        if not arrived.rows or cells[columns.time] != arrived.rows[0][columns.time]:
            time_s = columns.time_s(cells)
            latest = arrived.rows or arrived.last
            latest_s = columns.time_s(latest[0]) if latest else -inf
            is_late = time_s - latest_s < _SHORTEST_S
            if is_late and self._repeats(cells, arrived.last, number):
                return []
            if is_late and not arrived.goes_on_at(time_s):
                raise columns.file.error(
                    number,
                    "time",
                    f"time {time_s!r} s in a row that follows the epoch at {latest_s!r} s",
                    f"times that increase by at least {_SHORTEST_S:g} s",
                )
            over = self._end(user)
        arrived.late_s.clear()
        for before in arrived.rows:
            if not columns.agree(cells, before):
                if self._repeats(cells, [before], number):
                    return over
                _require_sound(columns.table([[*arrived.rows, cells]], number))
        arrived.rows.append(cells)
        if len(arrived.rows) == columns.most_rows:
            over += self._end(user)
        return over

    def forget(self, users: list[str]) -> None:
        """Forget users, who have left; clear the list."""
        for user in users:
            self._arrivals.pop(user, None)
        users.clear()

    def _repeats(self, cells: Cells, rows: list[Cells], number: int) -> bool:
        """Tell whether one of these rows has the same cells; count and report repeated rows."""
        if repr(cells) not in map(repr, rows):
            return False
        place = self._columns.file.place(number)
        self._report("repeated rows", f"repeated rows ({place})")
        return True

    def _report(self, name: str, note: str) -> None:
        """Count what was left out; the first of each name causes a warning."""
        self.left_out[name] += 1
        if self.left_out[name] == 1:
            self.warnings.append(f"left out: {note}")

    def add_epoch(self, rows: Iterable[Row]) -> list[LiveEpoch]:
        """Add all rows of an epoch, end it, and return the epochs that are now over.

        Raises:
            LogError: a row is damaged or late; all these rows are ignored.
        """
        rows = list(rows)
        users = dict.fromkeys(map(_user_of, rows))
        before = {  # late rows still count
            user: replace(arrived, rows=arrived.rows.copy())
            for user in users
            if (arrived := self._arrivals.get(user))
        }
        try:
            over = [epoch for row in rows for epoch in self.add(row)]
        except LogError:
            self._rows.clear()
            self.forget([*users])
            self._arrivals |= before
            raise
        return [*over, *self.end_epoch(rows)]

    def end_epoch(self, rows: Iterable[Any] = ()) -> list[LiveEpoch]:
        """End the epochs of the users of these mappings, or of all; return those that have rows.

        Raises:
            ValueError: all rows until the end, which no mappings mean, lack columns of a log.
        """
        if self._rows and not rows and not self._is_open:
            raise ValueError(self._problem)
        over = self._caught_up() if self._is_open else []  # rows behind a damaged one may wait
        users = dict.fromkeys(map(_user_of, rows)) or self._arrivals
        return over + [epoch for user in list(users) for epoch in self._end(user)]

    def _end(self, user: str) -> list[LiveEpoch]:
        """End a user's epoch; return a list with this epoch, or [] if it has no rows yet."""
        arrived = self._arrivals.get(user)
        if arrived is None or not arrived.rows:
            return []
        arrived.last = arrived.rows
        arrived.rows = []
        time_s = self._columns.time_s(arrived.last[0])
        return [LiveEpoch(user, time_s, arrived.last, self._columns)]

    def _cells(self, row: str | Row, number: int) -> tuple[str, Cells]:
        """Return a row's user ("" if unnamed) and cells (none if blank); refuse a damaged row."""
        columns = self._columns
        if isinstance(row, str):
            user = ""
            words = words_of(row, columns.file.delimiter)
            if self._user is not None and len(words) > self._user:
                user = words.pop(self._user).strip()
            cells = columns.file.quick_numbers(words) or []
        else:
            user = _user_of(row)
            cells = [nan if (cell := row.get(name)) is None else cell for name in columns.names]
        if cells and columns.are_plain(cells):
            return user, cells
        if not isinstance(row, str):
            read = [row.get(name) for name in columns.file.names]
            words = ["" if word is None else str(word) for word in read]
        table = parse(columns.file, [words], number)
        cells = table.cells.ravel().tolist()
        if cells and (table.damage or not columns.are_plain(cells)):
            table, notes = without_lost(table)
            _require_sound(table)
            for name, note in notes.items():
                self._report(name, note)
        return user, table.cells.ravel().tolist()

    def _learn(self, row: Iterable[str], number: int) -> None:
        """Add the columns of a row that no row had before; from now on, ignore unknown ones."""
        if self._known.issuperset(row):
            return
        names = [name for name in row if name not in self._known]
        before = self._columns.file.names if self._is_open else []
        try:
            file = self._file([*before, *self._waiting, *names])
        except LogError as error:
            if not self._is_open and QUANTITY_OF.keys() >= set(names):
                self._waiting += names
                self._problem = error
            elif len(names) > 1:
                for name in names:
                    self._learn([name], number)
            else:
                self.warnings.append(f"row {number}, column {names[0]!r} is ignored: {error}")
                if QUANTITY_OF.get(names[0]) in ODOMETRY_QUANTITIES:
                    self._waiting += names
        else:
            self._waiting.clear()
            self._columns = LiveColumns(file)
            self._is_open = True

            def widened(rows: list[Cells]) -> list[Cells]:
                return [row + [nan] * (len(file.columns) - len(row)) for row in rows]

            for arrived in self._arrivals.values():
                arrived.rows = widened(arrived.rows)
                arrived.last = widened(arrived.last)
        self._known.update(names)


def _user_of(row: Row) -> str:
    """Return the user of a row; "" if the row does not name any."""
    user = row.get(USER)
    return "" if user is None else str(user)


def _require_sound(table: Table) -> None:
    _, damage = first_damage(table)
    if damage:
        raise damage
