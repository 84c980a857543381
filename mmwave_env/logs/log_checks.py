"""Checks of the rows of a measurement log."""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.log_columns import DEVIATIONS, LOST, QUANTITIES, SIGMA_OF
from mmwave_env.logs.log_tables import LogError, Table
from mmwave_env.models import envelope
from mmwave_env.numerics.numbers import Array, Mask

MOST_PATHS = 1000  # maximum number of paths in an epoch of a log without anchor numbers
_UNKNOWN = 1e9  # deviations of this size, in any unit, say that the noise is not known
_WRONG_UNIT = 0.5  # with a larger share of values beyond its limits, a column has a wrong unit


def sound_epochs(table: Table, limits: bool) -> tuple[Table, LogError | None]:
    """Check the rows of a log; return those of all epochs before the first damage, and its error.

    Repeated rows are left out. They, and cells that :func:`without_lost` empties, cause a warning.

    Args:
        table: the rows.
        limits: whether to refuse columns that are mostly beyond physical limits.
    """
    table, notes = without_lost(table, _WRONG_UNIT if limits else 0.0)
    file = table.file
    if file.associated and (repeated := _repeated(table)).any():
        first = file.place(table.rows[np.argmax(repeated)])
        notes["repeated rows"] = f"repeated rows: {repeated.sum()} ({first})"
        table = table.part(~repeated)
    if notes:
        listed = "; ".join(notes.values())
        warnings.warn(f"{file.path}: left out: {listed}", stacklevel=3)
    damaged, error = first_damage(table, limits)
    anchors = file.layout.anchors if file.associated else None
    return table.part(slice(_end_of_epochs(table.raw("time"), damaged, anchors))), error


def without_lost(table: Table, most: float = 1.0) -> tuple[Table, dict[str, str]]:
    """Empty the cells that mean "lost", are infinite, or are beyond physical limits.

    If a standard deviation is emptied, its value is, too. If more than a share ``most`` of a column
    is beyond the limits, these cells are kept.

    Returns:
        The table, and a note on what was emptied in each column, by the column's name.
    """
    columns = table.columns
    cells = table.cells.copy()
    notes = {}
    # if one -1 in a row means "lost", all do
    never = [
        quantity
        for quantity, column in columns.items()
        if quantity in ("toa", "speed") or column.low > -1.0
    ]
    minus_one = np.any([table.raw(quantity) == -1.0 for quantity in never], axis=0)
    for quantity, column in columns.items():
        if quantity in ("time", "anchor"):
            continue
        raw = table.raw(quantity)
        lost = np.isinf(raw) | np.isin(abs(raw), LOST) | (minus_one & (raw == -1.0))
        if quantity in DEVIATIONS:  # many drivers write such numbers if they don't know it
            lost |= (raw <= 0.0) | (raw >= _UNKNOWN)
        beyond = _beyond(table, quantity) & ~lost
        if beyond.sum() <= most * (~np.isnan(raw) & ~lost).sum():
            lost |= beyond
        if lost.any():
            notes[column.name] = _note(table, quantity, lost)
            for i, other in enumerate(columns):
                if quantity in (other, SIGMA_OF.get(other)):
                    cells[lost, i] = np.nan
    return replace(table, cells=cells), notes


def _repeated(table: Table) -> Mask:
    """Tell which rows (n,) are equal to a row before them in their epoch."""
    order = np.lexsort([table.raw("anchor"), table.epoch])
    cells = table.cells[order]
    empty = np.isnan(cells)
    equal = (cells[1:] == cells[:-1]) | (empty[1:] & empty[:-1])
    repeated = np.zeros(len(table), bool)
    repeated[order[1:]] = equal.all(axis=1)
    repeated[-1:] &= table.damage is None
    return repeated


def _note(table: Table, quantity: str, wrong: Mask) -> str:
    """Return how many cells of a column are wrong, and the first of them."""
    column = table.columns[quantity]
    row = int(np.argmax(wrong))
    value = table.raw(quantity)[row]
    why = "which means lost"
    if not column.low <= value <= column.high:
        why = f"expected {_limit(table, quantity, wrong).expected}"
    place = table.file.place(table.rows[row])
    values = ", with their values" if quantity in DEVIATIONS else ""
    return f"{wrong.sum()} of {column.name!r}{values} ({_show(value)} in {place}, {why})"


class _Check(NamedTuple):
    """The result of a check of a column: the rows that fail, and words for the message."""

    quantity: str
    wrong: Mask  # (n,) whether each row fails
    expected: str
    words: Callable[[int], str] | None = None  # row -> what was found; if None, the cell is shown


def first_damage(table: Table, limits: bool = True) -> tuple[int, LogError | None]:
    """Return the first damaged row's index and error; if there is none, the row count and None."""
    n = len(table)
    first, error = (n - 1, table.damage) if table.damage else (n, None)
    if not n:
        return first, error
    with np.errstate(invalid="ignore", over="ignore"):  # times may be infinite
        for check in chain(_checks(table), _limits(table) if limits else ()):
            row = int(np.argmax(check.wrong))
            if check.wrong[row] and row < first:
                value = table.raw(check.quantity)[row]
                problem = check.words(row) if check.words else _show(value)
                error = table.file.error(table.rows[row], check.quantity, problem, check.expected)
                first = row
    return first, error


def _checks(table: Table) -> Iterator[_Check]:
    """Yield the checks that every log must pass."""
    time = table.raw("time")
    epoch = table.epoch
    yield _Check("time", ~np.isfinite(time), "a finite time in every row")
    yield _Check(
        "time",
        np.diff(time, prepend=time[0]) < 0.0,
        "times in increasing order, and the rows of an epoch together",
        lambda row: f"{_show(time[row])} after {_show(time[row - 1])}",
    )
    if table.file.associated:
        yield from _anchor_checks(table)
    else:
        number = np.arange(len(epoch)) - np.searchsorted(epoch, epoch)  # path's index in its epoch
        yield _Check(
            "time",
            number >= MOST_PATHS,
            f"at most {MOST_PATHS}",
            lambda row: f"{number[row] + 1} paths at the same time",
        )
    for quantity in table.columns:
        if QUANTITIES[quantity].per_epoch:
            yield _one_value(table, quantity)


def _anchor_checks(table: Table) -> Iterator[_Check]:
    """Yield the checks of rows that belong to an anchor."""
    anchors = table.file.layout.anchors
    time = table.raw("time")
    anchor = table.raw("anchor")
    known = np.isin(anchor, np.arange(1, anchors + 1))
    yield _Check(
        "anchor", ~known, f"the number of an anchor of the scene, 1 (the physical one) to {anchors}"
    )
    link = table.epoch * anchors + np.where(known, anchor, 1.0).astype(np.int64) - 1
    _, first, number = np.unique(link, return_index=True, return_inverse=True)
    yield _Check(
        "anchor",
        first[number] != np.arange(len(link)),
        "each anchor once per epoch; keep one of these rows, or their mean",
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


def _beyond(table: Table, quantity: str) -> Mask:
    """Tell which values (n,) are beyond the limits of their quantity."""
    column = table.columns[quantity]
    raw = table.raw(quantity)
    negative = quantity == "toa" and table.file.layout.has_bias  # the user's clock may be behind
    return (raw < (-column.high if negative else column.low)) | (raw > column.high)


def _limits(table: Table) -> Iterator[_Check]:
    """Yield the checks that values are within physical limits."""
    for quantity in table.columns:
        yield _limit(table, quantity, _beyond(table, quantity))
    step_s = np.diff(table["time"], prepend=np.nan)
    shortest = envelope.STEP_S.least or 0.0
    yield _Check(
        "time",
        (step_s > 0.0) & (step_s < shortest),
        f"the same time, or at least {shortest:g} s more",
        lambda row: f"{step_s[row]:.3g} s after the previous row",
    )


def _limit(table: Table, quantity: str, wrong: Mask) -> _Check:
    """Return the check that the values of a column are within the limits of their quantity."""
    bound, unit = QUANTITIES[quantity].limits
    values = table[quantity]
    if unit == "degrees":
        values = np.degrees(values)
    stem, _, ending = table.columns[quantity].name.rpartition("_")
    likely = f"if the value is in degrees, name the column {stem}_deg; " if ending == "rad" else ""
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
