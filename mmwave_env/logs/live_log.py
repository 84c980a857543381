"""Measurement logs that arrive row by row; every epoch is returned as soon as it is complete.

A row whose cells are well within their limits passes quick checks. All other rows need the full
checks of ``log_checks.py``, which are slower and also find out what is wrong.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from math import inf, isnan, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.logs.log import Log, PathEpoch, log_of, path_epochs, places
from mmwave_env.logs.log_checks import MOST_PATHS, first_damage, without_lost
from mmwave_env.logs.log_columns import BODY, LOST, QUANTITIES, STATION, USER
from mmwave_env.logs.log_tables import LogError, LogFile, Table, log_file, parse, words_of
from mmwave_env.models import envelope
from mmwave_env.models.layout import Layout, wrapped
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI, Index

_NUMBERS = {float, int, np.float64}  # types that need no parsing; others are parsed as text
_LOST = {-1.0, *LOST, *(-code for code in LOST)}  # numbers that need the full checks
_SHORTEST_S = envelope.STEP_S.least or 0.0
_LATE = 3  # number of late epochs, one after the other, with which a log goes on


class LiveEpoch(NamedTuple):
    """An epoch of a live log."""

    user: str  # the cell ``ue`` of its rows; "" without such a column
    time_s: float
    layout: Layout
    rows: list[list[float]]  # cells
    make: Callable[..., Log]  # turns rows with these columns, and perhaps their users, into a log
    # function for :meth:`placed`; None if some angles are not in the map's frame, or if the scene
    # corrects measurements
    place: Callable[[list[list[float]]], tuple[list[float], int]] | None

    def log(self) -> Log:
        """Return the epoch as a log, T = 1."""
        return self.make(self.rows)

    def placed(self) -> tuple[list[float], int] | None:
        """Return all values, and the index, from 0, of the anchor with the Doppler shift; or None.

        Values are in the order of :func:`~mmwave_env.logs.log.places`, NaN where not measured.
        """
        return self.place and self.place(self.rows)


def log_from(epochs: Iterable[LiveEpoch]) -> Log:
    """Return epochs of a user as a log."""
    parts = []
    for make, some in groupby(epochs, key=lambda epoch: epoch.make):
        parts.append(make([row for epoch in some for row in epoch.rows]))
    joined: Log = Log.joined(parts)
    return joined


def log_of_users(epochs: Sequence[LiveEpoch]) -> Log:
    """Return an epoch of each of T users, all with the same columns, as a log.

    The times of this log need not increase.
    """
    rows = [row for epoch in epochs for row in epoch.rows]
    users = np.repeat(np.arange(len(epochs)), [len(epoch.rows) for epoch in epochs])
    return epochs[0].make(rows, users)


@dataclass(slots=True)
class _Arrivals:
    """The rows that have arrived from a user."""

    rows: list[list[float]] = field(default_factory=list)  # of the current epoch
    last: list[list[float]] = field(default_factory=list)  # rows of the last epoch
    last_s: float = -inf
    late_s: list[float] = field(default_factory=list)  # increasing times of the latest, late rows

    def copy(self) -> "_Arrivals":
        """Return the same with a copy of the rows, as it was before rows that are refused."""
        return _Arrivals(self.rows.copy(), self.last, self.last_s, self.late_s)


class LiveLog:
    """A collector that groups the rows of a log into epochs as the rows arrive.

    An epoch is over when every anchor has a row, when a row with a later time arrives, or when
    :meth:`end_epoch` is called. Only the rows of two epochs are kept in memory. Rows may have a
    column ``ue``, any text, which names the user; each user has epochs of its own.

    Rows that are late are refused; but if they keep coming, with increasing times, a clock was set
    back, or one row had a time in the future: then the log goes on at the earlier time. A row of
    values by column may have a column that no row had before. Columns with unknown names are
    ignored, and the first row with one adds a warning.

    If rows are paths without anchor numbers, every epoch ends with a row of a later time, and
    :meth:`paths` returns its paths.

    Args:
        names: names of the columns, as in the header of a log.
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
        self._source = Path(source)
        self._associated = associated
        self._delimiter = delimiter
        self._scene = scene
        self._snr_db = snr_db
        self._clock = clock
        self.warnings: list[str] = []
        self.left_out: Counter[str] = Counter()
        self._ignored = {"", USER}
        self._arrivals: dict[str, _Arrivals] = {}  # by user
        self._user = names.index(USER) if USER in names else None
        self._set_columns([name for name in names if name != USER])

    def _set_columns(self, names: Sequence[str]) -> None:
        """Set the names of the columns, in any order; refuse wrong ones."""
        scene = self._scene
        log = log_file(
            self._source, names, self._delimiter, scene, snr_db=self._snr_db, clock=self._clock,
            associated=self._associated,
        )  # fmt: skip
        self.layout = log.layout
        self._log = log
        self._make = partial(_log, log)
        self._names = [*names]
        columns = self._log.columns
        corrected = bool(scene.bearing_deg or scene.range_offset_m or scene.range_offset_sigma_m)
        turned = STATION in columns or BODY in columns or corrected
        cell_of = {of: i for i, of in enumerate(columns)}
        self._time = cell_of["time"]
        self._anchor = cell_of.get("anchor", -1)
        slots = [
            (cell_of[of], *place, columns[of].unit.convert, place[0] in self.layout.angles)
            for of, place in places(self.layout).items()
            if of in columns
        ]
        snr = [nan if self._snr_db is None else self._snr_db] * self.layout.anchors
        blank = [nan] * 2 * self.layout.size + snr + [nan]
        placed = partial(_placed, self._anchor, slots, blank, self.layout.doppler)
        self._place = None if turned or not self._associated else placed
        self._limits = {column.name: (column.low, column.high) for column in columns.values()}
        self._known = self._ignored | self._limits.keys()
        self._anchors = set(range(1, self.layout.anchors + 1))
        self._of_epoch = [
            (i, of == "doppler")
            for of, i in cell_of.items()
            if QUANTITIES[of].per_epoch or (of == "doppler" and self._associated)
        ]

    def add(self, row: str | Mapping[str, Any], number: int = 0) -> list[LiveEpoch]:
        """Add a row: a line of CSV, or values by column; return the epochs that are now over.

        Error messages contain ``number``, the number of the row in the source.

        Raises:
            LogError: the row is damaged or late; it is ignored.
        """
        user, cells = self._cells(row, number)
        if not cells:
            return []
        arrived = self._arrivals.get(user)
        if arrived is None:
            arrived = self._arrivals[user] = _Arrivals()
        over = []
        if not arrived.rows or cells[self._time] != arrived.rows[0][self._time]:
            time_s = self._time_s(cells)
            latest_s = self._time_s(arrived.rows[0]) if arrived.rows else arrived.last_s
            is_late = time_s - latest_s < _SHORTEST_S
            if is_late and self._repeats(cells, arrived.last, number):
                return []
            if is_late and not _goes_on_at(arrived, time_s):
                problem = f"time {time_s!r} s in a row that follows the epoch at {latest_s!r} s"
                expected = f"times that increase by at least {_SHORTEST_S:g} s"
                raise self._log.error(number, "time", problem, expected)
            over = self._end(user)
        arrived.late_s.clear()
        for before in arrived.rows:
            if not self._agree(cells, before):
                if self._repeats(cells, [before], number):
                    return over
                self._require_sound(_table(self._log, [*arrived.rows, cells], number))
        arrived.rows.append(cells)
        if self._associated:
            whole = len(arrived.rows) == self.layout.anchors
        else:
            whole = len(arrived.rows) == MOST_PATHS
        return [*over, *(self._end(user) if whole else [])]

    @property
    def at_station(self) -> bool:
        """Tell whether angles of arrival were measured at the base station."""
        return STATION in self._log.columns

    def paths(self, epoch: LiveEpoch) -> PathEpoch:
        """Return the paths of an epoch."""
        (of_epoch,) = path_epochs(_table(self._log, epoch.rows))
        return of_epoch

    def forget(self, users: list[str]) -> None:
        """Forget users, who have left; clear the list."""
        for user in users:
            self._arrivals.pop(user, None)
        users.clear()

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

    def add_epoch(self, rows: Iterable[str | Mapping[str, Any]]) -> list[LiveEpoch]:
        """Add all rows of an epoch, end it, and return the epochs that are now over.

        Raises:
            LogError: a row is damaged or late; all these rows are ignored.
        """
        rows = list(rows)
        for row in rows:
            self._learn_from(row, 0)
        users = dict.fromkeys(map(self._user_of, rows))
        before = {user: self._arrivals[user].copy() for user in users if user in self._arrivals}
        try:
            over = [epoch for row in rows for epoch in self.add(row)]
        except LogError:
            self.forget([*users])
            self._arrivals |= before
            raise
        return [*over, *(epoch for user in users for epoch in self._end(user))]

    def end_epoch(self, rows: Iterable[str | Mapping[str, Any]] = ()) -> list[LiveEpoch]:
        """End the current epochs of the rows' users, or of all; return those that have rows."""
        users = dict.fromkeys(map(self._user_of, rows)) or self._arrivals
        return [epoch for user in list(users) for epoch in self._end(user)]

    def _end(self, user: str) -> list[LiveEpoch]:
        """End a user's epoch; return a list with this epoch, or [] if it has no rows yet."""
        arrived = self._arrivals.get(user)
        if arrived is None or not arrived.rows:
            return []
        rows = arrived.rows
        arrived.last_s = self._time_s(rows[0])
        arrived.rows = []
        arrived.last = rows
        return [LiveEpoch(user, arrived.last_s, self.layout, rows, self._make, self._place)]

    def _time_s(self, cells: list[float]) -> float:
        return float(self._log.columns["time"].unit.convert(cells[self._time]))

    def _agree(self, cells: list[float], before: list[float]) -> bool:
        """Tell whether two rows surely fit into one epoch; if not, they need the full checks."""
        for i, once in self._of_epoch:
            a = cells[i]
            b = before[i]
            if not isnan(a) and not isnan(b) and (once or a != b):
                return False
        return not self._associated or cells[self._anchor] != before[self._anchor]

    def _user_of(self, row: str | Mapping[str, Any]) -> str:
        """Return the user of a row; "" if the row does not name any."""
        if isinstance(row, str):
            return self._split(row)[0]
        return "" if (user := row.get(USER)) is None else str(user)

    def _split(self, line: str) -> tuple[str, list[str]]:
        """Return the user of a line, "" if it does not name any, and its other words."""
        words = words_of(line, self._delimiter)
        if self._user is None or len(words) <= self._user:
            return "", words
        return words.pop(self._user).strip(), words

    def _cells(self, row: str | Mapping[str, Any], number: int) -> tuple[str, list[float]]:
        """Return the user and cells of a row; no cells for a blank line; refuse a damaged row."""
        if isinstance(row, str):
            user, words = self._split(row)
            line = row if self._user is None else self._delimiter.join(words)
            cells = self._log.quick_numbers(line, words) or []
        else:
            self._learn_from(row, number)
            user = self._user_of(row)
            words = []
            cells = [nan if (cell := row.get(name)) is None else cell for name in self._limits]
        if cells and self._plain(cells):
            return user, cells
        if not isinstance(row, str):
            words = ["" if (cell := row.get(name)) is None else str(cell) for name in self._names]
        if not isinstance(row, str) or self._user is not None:
            row = self._delimiter.join(f'"{word}"' for word in words)
        table = parse(self._log, [row], number)
        cells = table.cells.ravel().tolist()
        if cells and (table.damage or not self._plain(cells)):
            table, notes = without_lost(table)
            self._require_sound(table)
            for name, note in notes.items():
                self._report(name, note)
        return user, table.cells.ravel().tolist()

    def _learn_from(self, row: str | Mapping[str, Any], number: int) -> None:
        """Add the columns of a row that no row had before."""
        if isinstance(row, str) or row.keys() <= self._known:
            return
        new = [name for name in row if name not in self._known]
        if new:
            self._learn(new, number)

    def _learn(self, names: list[str], number: int) -> None:
        """Add columns; ignore those that are unknown from now on."""
        before = list(self._limits)
        try:
            self._set_columns([*self._names, *names])
        except LogError as error:
            if len(names) == 1:
                self._ignored.add(names[0])
                self._known.add(names[0])
                self.warnings.append(f"row {number}, column {names[0]!r} is ignored: {error}")
            for name in names if len(names) > 1 else ():
                self._learn([name], number)
            return
        place = {name: i for i, name in enumerate(before)}
        for arrived in self._arrivals.values():
            arrived.rows = [
                [row[place[name]] if name in place else nan for name in self._limits]
                for row in arrived.rows
            ]

    def _plain(self, cells: list[Any]) -> bool:
        """Tell whether the cells of a row are surely sound; if not, they need the full checks."""
        for cell, (low, high) in zip(cells, self._limits.values(), strict=True):
            # NaN is an empty cell
            if type(cell) not in _NUMBERS or cell < low or cell > high or cell in _LOST:
                return False
        known = not self._associated or cells[self._anchor] in self._anchors
        return known and not isnan(cells[self._time])

    def _require_sound(self, table: Table) -> None:
        _, damage = first_damage(table)
        if damage:
            raise damage


def _placed(
    anchor_cell: int,
    slots: Sequence[tuple[int, int, int, Callable[[float], float], bool]],
    blank: list[float],
    doppler: int,
    rows: list[list[float]],
) -> tuple[list[float], int]:
    """Return :meth:`LiveEpoch.placed` from the cells of rows, each with its slot."""
    placed = blank.copy()
    doppler_anchor = 0
    for cells in rows:
        anchor = int(cells[anchor_cell]) - 1
        for i, first, step, convert, is_angle in slots:
            cell = cells[i]
            place = first + step * anchor
            if not isnan(cell) and (step or isnan(placed[place])):
                number = convert(cell)
                turned = is_angle and not -PI <= number < PI
                placed[place] = wrapped(number) if turned else number
                if first == doppler:
                    doppler_anchor = anchor
    return placed, doppler_anchor


def _table(
    file: LogFile, rows: list[list[float]], number: int = 0, users: Index | None = None
) -> Table:
    return Table(file, np.full(len(rows), number), np.array(rows, float), user=users)


def _log(file: LogFile, rows: list[list[float]], users: Index | None = None) -> Log:
    return log_of(_table(file, rows, users=users))


def _goes_on_at(arrived: _Arrivals, time_s: float) -> bool:
    """Tell whether so many late rows came in order that the log goes on at their time."""
    if not arrived.late_s or time_s > arrived.late_s[-1]:
        arrived.late_s.append(time_s)
    elif time_s < arrived.late_s[-1]:
        arrived.late_s = [time_s]
    if len(arrived.late_s) < _LATE:
        return False
    arrived.rows = []
    return True
