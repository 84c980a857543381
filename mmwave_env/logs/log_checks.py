"""Checks and conversion of the rows of a measurement log, as far as they are sound.

A damaged row is an error that names it; the whole epochs before it are delivered first.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.io.records import between
from mmwave_env.logs.log_tables import LogError, LogFile
from mmwave_env.models import envelope
from mmwave_env.numerics.numbers import Array, Mask

Cells = dict[str, Array]  # quantity -> (n,)

RANGE_LIMITS_M = (1e-3, 1e6)  # limits of any antenna and any cell; a mistaken unit exceeds them
WIDEST_DEG = {
    "aoa_azimuth": 360.0, "aoa_azimuth_station": 360.0, "aoa_elevation": 90.0,
    "aod_azimuth": 360.0, "aod_azimuth_body": 360.0,
}  # fmt: skip
SOUND = {  # limits within which filters are numerically sound
    "doppler": (envelope.BIAS_HZ, "Hz"),
    "doppler_spread": (envelope.DOPPLER_SPREAD_HZ, "Hz"),
    "speed": (envelope.VELOCITY_MPS, "m/s"),
    "snr": (between(-1e3, 1e3, "dB"), "dB"),
}
MOST_PATHS = 1000  # most paths in an epoch of a log without anchor numbers
_ROUNDING_DEG = 1e-4  # error of angles that were once 32-bit numbers


class EpochRows(NamedTuple):
    """Rows of whole epochs."""

    cells: Cells  # in s, m, rad, Hz, dB, m/s; NaN where empty
    epoch: NDArray[np.int64]  # (n,) epoch of every row, counted from 0
    rows: int  # number of rows of the file read, up to the end of these or somewhat further
    share: float  # share of the file read so far, 0 to 1

    @property
    def epochs(self) -> int:
        """Return the number of epochs."""
        return int(self.epoch[-1]) + 1

    def once(self, quantity: str) -> Array:
        """Return a quantity of the epoch from any of its rows (epochs,); NaN if missing."""
        out = np.full(self.epochs, np.nan)
        if quantity in self.cells:
            some = ~np.isnan(self.cells[quantity])
            out[self.epoch[some]] = self.cells[quantity][some]
        return out


def whole_epochs(log: LogFile, anchors: int | None, limits: bool) -> Iterator[EpochRows]:
    """Yield whole epochs, as many at a time as each table completes.

    Args:
        log: the file.
        anchors: number of anchors in the scene; None where rows are paths without numbers.
        limits: whether to refuse numbers beyond physical limits.

    Raises:
        LogError: for the first damaged row.
    """
    cells, rows, done, share = np.empty((len(log.columns), 0)), np.empty(0, np.int64), 0, 0.0
    for table in log.tables():
        # The last epoch of the tables before may go on in this table.
        cells = np.concatenate([cells, table.cells], axis=1)
        rows = np.concatenate([rows, table.rows])
        done, share = done + len(table.rows), table.share
        named = dict(zip(log.columns, cells, strict=True))
        checks = chain(_checks(named, anchors), _limits(log, named) if limits else ())
        damaged, error = _first_damage(log, checks, rows, table.damage)
        end = _end_of_epochs(named["time"], damaged, anchors)
        if end:
            yield _converted(log, cells[:, :end], done, share)
        if error:
            raise error
        cells, rows = cells[:, end:], rows[end:]
    if len(rows):
        yield _converted(log, cells, done, share)


def _converted(log: LogFile, rows: Array, done: int, share: float) -> EpochRows:
    cells = {
        quantity: values * column.unit.multiply / column.unit.divide
        for (quantity, column), values in zip(log.columns.items(), rows, strict=True)
    }
    # Use the times in the file: two of them may be equal after conversion to seconds.
    found = EpochRows(cells, _epochs(rows[list(log.columns).index("time")]), done, share)
    if "aod_azimuth_body" in cells:  # without a heading in the epoch there is no departure
        heading = found.once("heading")[found.epoch]
        cells["aod_azimuth"] = cells["aod_azimuth_body"] + heading
    return found


# --- damage


class _Check(NamedTuple):
    """A check: the rows (n,) of a column that fail it, and the words of the error."""

    quantity: str
    wrong: Mask
    found: Callable[[int], str]
    expected: str


def _first_damage(
    log: LogFile, checks: Iterable[_Check], rows: NDArray[np.int64], damage: LogError | None
) -> tuple[int, LogError | None]:
    """Return index and error of the first damaged row; without one, the number of rows."""
    n = len(rows)
    first, error = (n - 1, damage) if damage else (n, None)
    with np.errstate(invalid="ignore", over="ignore"):  # for infinite times and ranges
        for check in checks if n else ():
            row = int(np.argmax(check.wrong))
            if check.wrong[row] and row < first:
                first, expected = row, f"expected {check.expected}"
                error = log.error(rows[row], check.quantity, check.found(row), expected)
    return first, error


def _checks(cells: Cells, anchors: int | None) -> Iterator[_Check]:
    """Yield the checks of any log; damage found in a row may hide later damage."""
    time = cells["time"]
    for quantity, values in cells.items():
        found = _shows(cells, quantity)
        yield _Check(quantity, np.isinf(values), found, "a finite number, or nothing")
    yield _Check("time", np.isnan(time), lambda row: "nothing", "a time in every row")
    yield _Check(
        "time",
        np.concatenate([[False], np.diff(time) < 0.0]),
        lambda row: f"{_show(time[row])} after {_show(time[row - 1])}",
        "times that increase, and the rows of an epoch together",
    )
    epoch = _epochs(time)
    yield from _path_checks(epoch) if anchors is None else _anchor_checks(cells, anchors, epoch)
    for quantity in ("toa", "doppler_spread"):
        if quantity in cells:
            yield _Check(quantity, cells[quantity] < 0.0, _shows(cells, quantity), "at least 0")
    for quantity in ("doppler_spread", "speed", "heading"):
        if quantity in cells:
            yield _once(quantity, cells[quantity], epoch)


def _anchor_checks(cells: Cells, anchors: int, epoch: NDArray[np.int64]) -> Iterator[_Check]:
    """Yield the checks of rows that belong to an anchor."""
    time, anchor = cells["time"], cells["anchor"]
    known = np.isin(anchor, np.arange(1, anchors + 1))
    expected = f"the number of an anchor of the scene, 1 to {anchors}, 1 being the physical one"
    yield _Check("anchor", ~known, _shows(cells, "anchor"), expected)
    place = epoch * anchors + np.where(known, anchor, 1.0).astype(np.int64) - 1
    yield _Check(
        "anchor",
        _first(place)[place] != np.arange(len(place)),
        lambda row: f"{_show(anchor[row])} a second time at time {_show(time[row])}",
        "each anchor once in an epoch",
    )
    if "doppler" in cells:
        elsewhere = ~np.isnan(cells["doppler"]) & (anchor != 1.0)
        expected = "none but in the rows of anchor 1"
        yield _Check("doppler", elsewhere, _shows(cells, "doppler"), expected)


def _path_checks(epoch: NDArray[np.int64]) -> Iterator[_Check]:
    """Yield the checks of rows that are paths: their number in an epoch is limited."""
    number = np.arange(len(epoch)) - _first(epoch)[epoch]  # number of the path in its epoch, from 0
    yield _Check(
        "time",
        number >= MOST_PATHS,
        lambda row: f"{number[row] + 1} paths at one time",
        f"at most {MOST_PATHS}",
    )


def _limits(log: LogFile, cells: Cells) -> Iterator[_Check]:
    """Yield the checks that numbers are within physical limits."""

    def converted(quantity: str) -> Array:
        unit = log.columns[quantity].unit
        return cells[quantity] * unit.multiply / unit.divide

    def check(quantity: str, values: Array, most: float, unit: str, expected: str) -> _Check:
        def found(row: int) -> str:
            return f"{_show(cells[quantity][row])}, which is {values[row]:.3g} {unit}"

        stem, _, ending = log.columns[quantity].name.rpartition("_")
        wrong = abs(values) > most
        likely = f"if it is in degrees, name the column {stem}_deg; " if ending == "rad" else ""
        if quantity == "aoa_elevation" and abs(values[np.argmax(wrong)]) <= azimuth_most:
            likely += f"if it is the azimuth, exchange {azimuth.name} with it; "
        return _Check(
            quantity,
            wrong,
            found,
            f"{expected}, in the unit that the name of the column ends with; {likely}"
            "mmwave-loc localize --diagnose tries likely mistakes",
        )

    azimuth = log.columns.get("aoa_azimuth") or log.columns["aoa_azimuth_station"]
    azimuth_most = WIDEST_DEG["aoa_azimuth"] + _ROUNDING_DEG
    longest = f"at most {RANGE_LIMITS_M[1] / 1e3:g} km"
    yield check("toa", converted("toa"), RANGE_LIMITS_M[1], "m", longest)
    for quantity, widest in WIDEST_DEG.items():
        if quantity not in cells:
            continue
        level = " from the horizon" if quantity == "aoa_elevation" else ""
        expected = f"{-widest:g} to {widest:g} degrees{level} (docs/data.md, Angles)"
        most = widest + _ROUNDING_DEG
        yield check(quantity, np.degrees(converted(quantity)), most, "degrees", expected)
    for quantity, (bound, unit) in SOUND.items():
        if quantity in cells:
            assert bound.most is not None
            yield check(quantity, converted(quantity), bound.most, unit, bound.expected)
    step_s = np.diff(converted("time"), prepend=np.nan)
    shortest = envelope.STEP_S.least or 0.0
    yield _Check(
        "time",
        (step_s > 0.0) & (step_s < shortest),
        lambda row: f"{step_s[row]:.3g} s after the row before",
        f"the time of that row, or at least {shortest:g} s more",
    )


def _once(quantity: str, values: Array, epoch: NDArray[np.int64]) -> _Check:
    """Return the check that rows of an epoch don't contradict each other."""
    some = np.flatnonzero(~np.isnan(values))
    first = np.full(epoch[-1] + 1, np.nan)
    first[epoch[some[::-1]]] = values[some[::-1]]
    return _Check(
        quantity,
        ~np.isnan(values) & (values != first[epoch]),
        lambda row: f"{_show(values[row])} beside {_show(first[epoch[row]])} at one time",
        "one value in an epoch",
    )


def _first(place: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the first row at every place, from the place of every row (n,)."""
    out = np.zeros(place.max() + 1, np.int64)
    out[place[::-1]] = np.arange(len(place))[::-1]  # of several rows, the last one stored stays
    return out


def _shows(cells: Cells, quantity: str) -> Callable[[int], str]:
    """Return a function that words the cell in a row of a column."""
    return lambda row: _show(cells[quantity][row])


def _show(value: float) -> str:
    return "nothing" if np.isnan(value) else repr(float(value)).removesuffix(".0")


def _end_of_epochs(time: Array, damaged: int, anchors: int | None) -> int:
    """Return the number of rows before a damaged row that are in epochs known to be whole."""
    if damaged == 0:
        return 0
    last = time[damaged - 1]
    start = int(np.searchsorted(time[:damaged], last))
    if damaged == len(time):  # no damage, but the next table may go on with the same epoch
        return start
    following = time[damaged]
    moved_on = last < following < np.inf
    complete = damaged - start == anchors and following != last
    return damaged if moved_on or complete else start


def _epochs(time: Array) -> NDArray[np.int64]:
    """Return the epoch, from 0, of every row (n,); the rows of an epoch have the same time."""
    return np.concatenate([[0], np.cumsum(np.diff(time) != 0.0)])
