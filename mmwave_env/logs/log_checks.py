"""Checks of the rows of a measurement log."""

from collections.abc import Callable, Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np

from mmwave_env.io.records import Bound
from mmwave_env.logs.log_columns import QUANTITIES, STATION
from mmwave_env.logs.log_tables import LogError, Table
from mmwave_env.models import envelope
from mmwave_env.models.layout import Layout
from mmwave_env.numerics.numbers import Array, Mask

MOST_PATHS = 1000  # maximum number of paths in an epoch of a log without anchor numbers
_ROUNDING_DEG = 1e-4  # rounding error of angles that were once stored as 32-bit numbers


def sound_epochs(
    table: Table, layout: Layout | None, limits: bool
) -> tuple[Table, LogError | None]:
    """Check the rows of a log; return those of all epochs before the first damage, and its error.

    Args:
        table: the rows.
        layout: layout of the log; None if rows are paths without anchor numbers.
        limits: whether to refuse values beyond physical limits.
    """
    damaged, error = first_damage(table, layout, limits)
    anchors = layout.anchors if layout else None
    return table.part(slice(_end_of_epochs(table.raw("time"), damaged, anchors))), error


class _Check(NamedTuple):
    """The result of a check of a column: the rows that fail, and words for the message."""

    quantity: str
    wrong: Mask  # (n,) whether each row fails
    expected: str
    words: Callable[[int], str] | None = None  # row -> what was found; if None, the cell is shown


def first_damage(table: Table, layout: Layout | None, limits: bool) -> tuple[int, LogError | None]:
    """Return the first damaged row's index and error; if there is none, the row count and None."""
    n = len(table)
    first, error = (n - 1, table.damage) if table.damage else (n, None)
    if not n:
        return first, error
    with np.errstate(invalid="ignore", over="ignore"):  # times and ranges may be infinite
        for check in chain(_checks(table, layout), _limits(table) if limits else ()):
            row = int(np.argmax(check.wrong))
            if check.wrong[row] and row < first:
                number = _show(table.raw(check.quantity)[row])
                problem = check.words(row) if check.words else number
                error = table.file.error(table.rows[row], check.quantity, problem, check.expected)
                first = row
    return first, error


def _checks(table: Table, layout: Layout | None) -> Iterator[_Check]:
    """Yield the checks that every log must pass."""
    time = table.raw("time")
    epoch = table.epoch
    yield _Check("time", np.isnan(time), "a time in every row")
    yield _Check(
        "time",
        np.diff(time, prepend=time[0]) < 0.0,
        "times in increasing order, and the rows of an epoch together",
        lambda row: f"{_show(time[row])} after {_show(time[row - 1])}",
    )
    if layout is None:
        number = np.arange(len(epoch)) - np.searchsorted(epoch, epoch)  # path's index in its epoch
        yield _Check(
            "time",
            number >= MOST_PATHS,
            f"at most {MOST_PATHS}",
            lambda row: f"{number[row] + 1} paths at the same time",
        )
    else:
        yield from _anchor_checks(table, layout.anchors)
    for quantity in table.columns:
        values = table.raw(quantity)
        limits = QUANTITIES[quantity].limits
        may_be_negative = layout and layout.clock and quantity == "toa"
        yield _Check(quantity, np.isinf(values), "a finite number, or nothing")
        if limits and limits[0].least == 0.0 and not may_be_negative:
            yield _Check(quantity, values < 0.0, "at least 0")
        if QUANTITIES[quantity].per_epoch:
            yield _one_value(table, quantity)


def _anchor_checks(table: Table, anchors: int) -> Iterator[_Check]:
    """Yield the checks of rows that belong to an anchor."""
    time = table.raw("time")
    anchor = table.raw("anchor")
    known = np.isin(anchor, np.arange(1, anchors + 1))
    expected = f"the number of an anchor of the scene, 1 (the physical one) to {anchors}"
    yield _Check("anchor", ~known, expected)
    link = table.epoch * anchors + np.where(known, anchor, 1.0).astype(np.int64) - 1
    _, first, number = np.unique(link, return_index=True, return_inverse=True)
    yield _Check(
        "anchor",
        first[number] != np.arange(len(link)),
        "each anchor once per epoch",
        lambda row: f"{_show(anchor[row])} twice at time {_show(time[row])}",
    )
    if "doppler" in table.columns:
        shifted = ~np.isnan(table.raw("doppler"))
        again = shifted & (anchor != table.first(np.where(shifted, anchor, np.nan))[table.epoch])
        yield _Check("doppler", again, "the Doppler shift of only one anchor per epoch")


def _one_value(table: Table, quantity: str) -> _Check:
    """Return the check that the rows of an epoch have the same value of a quantity."""
    values = table.raw(quantity)
    first = table.first(values)[table.epoch]
    return _Check(
        quantity,
        ~np.isnan(values) & (values != first),
        "one value per epoch",
        lambda row: f"{_show(values[row])} and {_show(first[row])} at the same time",
    )


def _limits(table: Table) -> Iterator[_Check]:
    """Yield the checks that values are within physical limits."""
    for quantity in table.columns:
        limits = QUANTITIES[quantity].limits
        if limits:
            yield _limit(table, quantity, *limits)
    step_s = np.diff(table["time"], prepend=np.nan)
    shortest = envelope.STEP_S.least or 0.0
    yield _Check(
        "time",
        (step_s > 0.0) & (step_s < shortest),
        f"the same time, or at least {shortest:g} s more",
        lambda row: f"{step_s[row]:.3g} s after the previous row",
    )


def _limit(table: Table, quantity: str, bound: Bound, unit: str) -> _Check:
    """Return the check that the values of a column are within the limits of their quantity."""
    values = table[quantity]
    most = bound.most or 0.0
    if unit == "degrees":
        values = np.degrees(values)
        most = most + _ROUNDING_DEG
    wrong = abs(values) > most
    if (least := bound.least or 0.0) > 0.0:
        wrong |= values < least
    stem, _, ending = table.columns[quantity].name.rpartition("_")
    likely = f"if the value is in degrees, name the column {stem}_deg; " if ending == "rad" else ""
    azimuth = table.columns.get("aoa_azimuth") or table.columns.get(STATION)
    if quantity == "aoa_elevation" and azimuth and abs(values[np.argmax(wrong)]) <= 360.0:
        likely += f"if the value is the azimuth, swap the names of this column and {azimuth.name}; "
    return _Check(
        quantity,
        wrong,
        f"{bound.expected}, in the unit that the name of the column ends with; {likely}"
        "mmwave-loc localize --diagnose looks for a likely mistake",
        lambda row: f"{_show(table.raw(quantity)[row])}, which is {values[row]:.3g} {unit}",
    )


def _show(value: float) -> str:
    return "nothing" if np.isnan(value) else repr(float(value)).removesuffix(".0")


def _end_of_epochs(time: Array, damaged: int, anchors: int | None) -> int:
    """Count the rows, before the damaged row, that belong to epochs known to be complete."""
    if damaged in (0, len(time)):
        return damaged
    last = time[damaged - 1]
    start = int(np.searchsorted(time[:damaged], last))
    following = time[damaged]
    moved_on = last < following < np.inf
    complete = damaged - start == anchors and following != last
    return damaged if moved_on or complete else start
