"""Measurement logs: one row per epoch and anchor, as a receiver writes them.

Columns (`log_columns.py`) are a quantity and a unit: ``time_s, anchor, toa_s,
aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad, doppler_hz, snr_db``, and optionally
``doppler_spread_hz`` and odometry, ``speed_mps`` and ``heading_rad``. An anchor is its number
in the scene, from 1, the physical gNB, whose rows alone have a Doppler shift. What was not
measured is empty; an anchor that was not seen may be left out. What belongs to the epoch and
not to an anchor (Doppler spread, odometry) may stand in any of its rows.

A log may be longer than memory, so it is read in blocks.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.logs.blocks import Block, in_windows
from mmwave_env.logs.log_columns import LINK_QUANTITIES
from mmwave_env.logs.log_tables import LogError, LogFile, open_log
from mmwave_env.models.measurement import Layout, whole_groups, wrap_angles
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.arrays import Array, Mask

Cells = dict[str, Array]  # quantity -> (n,)

RANGE_LIMITS_M = (1e-3, 1e6)  # of any antenna, of any cell; a unit mistaken goes further
WIDEST_DEG = {"aoa_azimuth": 360.0, "aoa_elevation": 90.0, "aod_azimuth": 360.0}
_ROUNDING_DEG = 1e-4  # of angles that were 32-bit numbers once


@dataclass(frozen=True, eq=False)
class LogBlock(Block):
    """T consecutive epochs of a log; numbers of groups that are not visible mean nothing.

    Attributes:
        layout: rows and groups.
        time_s: (T,) increasing, also from block to block.
        measurement: (T, rows) m, rad, Hz, m/s; angles in [-pi, pi).
        visible: (T, groups) whether every number of the group was measured; for a link and for
            the Doppler shift that includes the SNR, because their noise follows from it.
        incomplete: (T, groups) whether only some of them were, so that the group is lost.
        snr_db: (T, L); -inf, no signal, where none was measured.
        doppler_spread_hz: (T,); 0 where none was measured.
        rows: of the file, read up to the end of this block or somewhat further.
        share: of the file read so far, 0 to 1.
    """

    layout: Layout
    time_s: Array
    measurement: Array
    visible: Mask
    incomplete: Mask
    snr_db: Array
    doppler_spread_hz: Array
    rows: int
    share: float

    per_epoch = (
        "time_s", "measurement", "visible", "incomplete", "snr_db", "doppler_spread_hz"
    )  # fmt: skip


def read_log(
    path: Path,
    scene: Scene,
    epochs_per_block: int = 4096,
    odometry: bool = True,
    limits: bool = True,
) -> Iterator[LogBlock]:
    """The epochs of a log, ``epochs_per_block`` at a time; the last block may be shorter.

    Angles are in the frame of the map. Arrival is seen at the anchor: the direction anchor ->
    user. Departure is the azimuth user -> anchor. docs/data.md has a figure, and how to convert.

    Where the log is damaged, every whole epoch before the damage is delivered first. An epoch
    whose end the damage hides (no next time can be read, and not all anchors are there) counts
    as not whole.

    Args:
        path: CSV (``.csv``, ``.csv.gz``) or Parquet (``.parquet``, needs the extra `data`).
        scene: whose anchors were measured.
        epochs_per_block: their number.
        odometry: False to leave columns of odometry alone. Otherwise ``layout`` has odometry
            where the log has it.
        limits: False to take ranges and angles of any size as they are, angles not wrapped, for
            a diagnosis.

    Raises:
        LogError: at once for a file or a header that is not a log's, later for a damaged row,
            naming file, row, column, what was found and what was expected; at the end for a
            log without rows or without a single measurement.
        OSError: the file can't be read.
    """
    if epochs_per_block < 1:
        raise ValueError(f"epochs_per_block: found {epochs_per_block}, expected at least 1")
    log = open_log(path, scene.hz_per_mps, odometry)
    layout = Layout(len(scene.anchors_m), "speed" in log.columns)
    blocks = _blocks(log, layout, limits)
    return _regroup(_require_measurements(log.path, blocks), epochs_per_block)


def _blocks(log: LogFile, layout: Layout, limits: bool) -> Iterator[LogBlock]:
    """Blocks of as many epochs as each table happens to bring to their end."""
    cells, rows, done, share = np.empty((len(log.columns), 0)), np.empty(0, np.int64), 0, 0.0
    for table in log.tables():
        # What is left of the tables before is the last epoch, which may go on.
        cells = np.concatenate([cells, table.cells], axis=1)
        rows = np.concatenate([rows, table.rows])
        done, share = done + len(table.rows), table.share
        named = dict(zip(log.columns, cells, strict=True))
        checks = chain(_checks(named, layout.anchors), _limits(log, named) if limits else ())
        damaged, error = _first_damage(log, checks, rows, table.damage)
        end = _whole_epochs(named["time"], damaged, layout.anchors)
        if end:
            yield _block(log, cells[:, :end], layout, limits, done, share)
        if error:
            raise error
        cells, rows = cells[:, end:], rows[end:]
    if len(rows):
        yield _block(log, cells, layout, limits, done, share)


def _require_measurements(path: Path, blocks: Iterable[LogBlock]) -> Iterator[LogBlock]:
    """The blocks, and an error after them if there was nothing in them."""
    rows, incomplete, measured = 0, 0, False
    for block in blocks:
        rows, incomplete = block.rows, incomplete + int(block.incomplete.sum())
        measured = measured or bool(block.visible.any())
        yield block
    if not measured:
        found = f"{rows} rows" if rows else "a header and no rows"
        lost = f", and {incomplete} groups with only some of their numbers" if incomplete else ""
        raise LogError(f"{path}: found {found} without a measurement{lost}, expected at least one")


def _regroup(blocks: Iterable[LogBlock], epochs: int) -> Iterator[LogBlock]:
    """Blocks of ``epochs`` epochs, and what is left."""
    for whole in in_windows(blocks, epochs):
        for first in range(0, len(whole), epochs):
            yield whole.part(slice(first, first + epochs))


# --- what is wrong


class _Check(NamedTuple):
    """Something that must not be: in which rows (n,) of a column it is, and how to say it."""

    quantity: str
    wrong: Mask
    found: Callable[[int], str]
    expected: str


def _first_damage(
    log: LogFile, checks: Iterable[_Check], rows: NDArray[np.int64], damage: LogError | None
) -> tuple[int, LogError | None]:
    """Index and error of the first damaged row; without one, the number of rows."""
    n = len(rows)
    first, error = (n - 1, damage) if damage else (n, None)
    with np.errstate(invalid="ignore", over="ignore"):  # infinite times, endless ranges
        for check in checks if n else ():
            row = int(np.argmax(check.wrong))
            if check.wrong[row] and row < first:
                first, expected = row, f"expected {check.expected}"
                error = log.error(rows[row], check.quantity, check.found(row), expected)
    return first, error


def _checks(cells: Cells, anchors: int) -> Iterator[_Check]:
    """What to check of any log; damage already seen in a row may hide what comes later."""
    time, anchor = cells["time"], cells["anchor"]

    def cell(quantity: str) -> Callable[[int], str]:
        return lambda row: _show(cells[quantity][row])

    for quantity, values in cells.items():
        yield _Check(quantity, np.isinf(values), cell(quantity), "a finite number, or nothing")
    yield _Check("time", np.isnan(time), lambda row: "nothing", "a time in every row")
    yield _Check(
        "time",
        np.concatenate([[False], np.diff(time) < 0.0]),
        lambda row: f"{_show(time[row])} after {_show(time[row - 1])}",
        "times that increase, and the rows of an epoch together",
    )
    known = np.isin(anchor, np.arange(1, anchors + 1))
    yield _Check(
        "anchor",
        ~known,
        cell("anchor"),
        f"the number of an anchor of the scene, 1 to {anchors}, 1 being the physical one",
    )
    epoch = _epochs(time)
    place = epoch * anchors + np.where(known, anchor, 1.0).astype(np.int64) - 1
    yield _Check(
        "anchor",
        _first(place)[place] != np.arange(len(place)),
        lambda row: f"{_show(anchor[row])} a second time at time {_show(time[row])}",
        "each anchor once in an epoch",
    )
    yield _Check("toa", cells["toa"] < 0.0, cell("toa"), "at least 0")
    if "doppler" in cells:
        elsewhere = ~np.isnan(cells["doppler"]) & (anchor != 1.0)
        yield _Check("doppler", elsewhere, cell("doppler"), "none but in the rows of anchor 1")
    if "doppler_spread" in cells:
        spread = cells["doppler_spread"]
        yield _Check("doppler_spread", spread < 0.0, cell("doppler_spread"), "at least 0")
    for quantity in ("doppler_spread", "speed", "heading"):
        if quantity in cells:
            yield _once(quantity, cells[quantity], epoch)


def _limits(log: LogFile, cells: Cells) -> Iterator[_Check]:
    """No range and no angle is beyond what there can be."""

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
            likely += f"if it is the azimuth, exchange {log.columns['aoa_azimuth'].name} with it; "
        return _Check(
            quantity,
            wrong,
            found,
            f"{expected}, in the unit that the name of the column ends with; {likely}"
            "mmwave-loc localize --diagnose tries likely mistakes",
        )

    azimuth_most = WIDEST_DEG["aoa_azimuth"] + _ROUNDING_DEG
    longest = f"at most {RANGE_LIMITS_M[1] / 1e3:g} km"
    yield check("toa", converted("toa"), RANGE_LIMITS_M[1], "m", longest)
    for quantity, widest in WIDEST_DEG.items():
        level = " from the horizon" if quantity == "aoa_elevation" else ""
        expected = f"{-widest:g} to {widest:g} degrees{level} (docs/data.md, Angles)"
        most = widest + _ROUNDING_DEG
        yield check(quantity, np.degrees(converted(quantity)), most, "degrees", expected)


def _once(quantity: str, values: Array, epoch: NDArray[np.int64]) -> _Check:
    """The check that rows of an epoch don't contradict each other."""
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
    """The first row at every place, from the place of every row (n,)."""
    out = np.zeros(place.max() + 1, np.int64)
    out[place[::-1]] = np.arange(len(place))[::-1]  # of several, the last one stored stays
    return out


def _show(value: float) -> str:
    return "nothing" if np.isnan(value) else repr(float(value)).removesuffix(".0")


def _whole_epochs(time: Array, damaged: int, anchors: int) -> int:
    """Number of rows, of those before a damaged one, in epochs that are known to be whole."""
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


# --- what it means


def _epochs(time: Array) -> NDArray[np.int64]:
    """The epoch, counted from 0, of every row (n,); the rows of an epoch share their time."""
    return np.concatenate([[0], np.cumsum(np.diff(time) != 0.0)])


def _block(
    log: LogFile, rows: Array, layout: Layout, wrap: bool, done: int, share: float
) -> LogBlock:
    """The epochs of valid rows (quantities, n)."""
    cells = {
        quantity: values * column.unit.multiply / column.unit.divide
        for (quantity, column), values in zip(log.columns.items(), rows, strict=True)
    }
    epoch = _epochs(rows[list(log.columns).index("time")])
    T, L = int(epoch[-1]) + 1, layout.anchors
    anchor = cells["anchor"].astype(np.int64) - 1
    time, snr, measurement = np.empty(T), np.full((T, L), np.nan), np.full((T, layout.size), np.nan)
    time[epoch] = cells["time"]
    snr[epoch, anchor] = cells["snr"]
    for i, quantity in enumerate(LINK_QUANTITIES):
        measurement[epoch, 4 * anchor + i] = cells[quantity]

    def once(quantity: str) -> Array:
        out = np.full(T, np.nan)
        if quantity in cells:
            some = ~np.isnan(cells[quantity])
            out[epoch[some]] = cells[quantity][some]
        return out

    measurement[:, layout.doppler] = once("doppler")
    if layout.odometry:
        measurement[:, layout.doppler + 1] = once("speed")
        measurement[:, layout.doppler + 2] = once("heading")
    if wrap:
        wrap_angles(measurement, layout)
    visible, incomplete = whole_groups(measurement, np.isfinite(snr), layout)
    return LogBlock(
        layout=layout,
        time_s=time,
        measurement=measurement,
        visible=visible,
        incomplete=incomplete,
        snr_db=np.where(np.isnan(snr), -np.inf, snr),
        doppler_spread_hz=np.nan_to_num(once("doppler_spread")),
        rows=done,
        share=share,
    )
