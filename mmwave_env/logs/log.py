"""Measurement logs, which receivers write: one row per epoch and anchor.

The name of a column (`log_columns.py`) is a quantity and a unit: ``time_s, anchor, toa_s,
aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad, doppler_hz, snr_db``, and optionally
``doppler_spread_hz``, ``speed_mps`` and ``heading_rad`` (odometry). An anchor is given by its
number in the scene. Number 1 is the physical gNB, usually the only anchor with a Doppler shift. A
cell is empty if its value was not measured. A row without any value may be missing. Doppler spread
and odometry belong to the epoch, not to an anchor, so they may be in any row of the epoch.

A log of paths has the same columns without ``anchor``, and one row for each path that a receiver
finds in an epoch. The rows of an epoch are in any order and may include false paths. Every path may
have a Doppler shift, because it is not known yet which path belongs to the base station.

A log may be larger than memory, so it is read in blocks of consecutive epochs.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from mmwave_env.logs.log_checks import whole_epochs
from mmwave_env.logs.log_columns import (
    BODY,
    LINK_QUANTITIES,
    QUANTITIES,
    ROW_QUANTITIES,
    SIGMA_OF,
    STATION,
)
from mmwave_env.logs.log_tables import Block, LogError, LogFile, Table, open_log
from mmwave_env.models.layout import Layout, whole_groups, without_noise, wrap_angles, wrapped
from mmwave_env.models.measurement import seen_from_image
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index, Mask


@dataclass(frozen=True, eq=False)
class LogBlock(Block):
    """T consecutive epochs of a log; values in groups that are not visible are meaningless.

    A segment is a part of a log without a long gap, and is tracked separately. The fields about
    segments are set by :func:`~mmwave_env.localization.segments.segments`.
    """

    layout: Layout  # a measurement's values, in order; groups are links, Doppler shift, odometry
    time_s: Array  # (T,) increasing, also across blocks
    measurement: Array  # (T, rows) m, rad, Hz, m/s; angles in [-pi, pi)
    sigma: Array  # (T, rows) the receiver's own standard deviations; NaN where it states none
    # (T, groups) whether the group can be used. All its values must be measured; links and the
    # Doppler shift also need an SNR. In a partial layout, one value with known noise is enough
    visible: Mask
    # (T, groups) whether the group is left out because a value or the SNR is missing. In a partial
    # layout, whether a value of the group is left out because its noise is unknown
    incomplete: Mask
    doppler_anchor: Index  # (T,) index, from 0, of the anchor with the Doppler shift
    snr_db: Array  # (T, L); -inf (no signal) where no SNR was measured
    doppler_spread_hz: Array  # (T,); 0 where none was measured
    # (T,) whether the association of paths with anchors began a new track here, so that the filters
    # must begin one, too. Always False in a log with anchor numbers
    restarts: Mask
    share: float  # share of the file read so far, 0 to 1
    whole_columns: bool = True  # whether the log has a column for each value of a link
    segment: int = 0  # number, from 0, of the segment that contains all epochs of the block
    begins: bool = False  # whether this block begins the segment; its first epoch gives the prior
    skipped: int = 0  # number of epochs of the log before the first segment
    # number of epochs dropped between segments so far, including those just after this block
    dropped: int = 0

    def whole(self) -> "LogBlock":
        """Return the block in the plain (not partial) layout; incomplete groups are not visible."""
        layout = replace(self.layout, partial=False)
        visible, _ = whole_groups(self.measurement, np.isfinite(self.snr_db), layout)
        visible[:, layout.anchors] &= self.doppler_anchor == 0
        return replace(self, layout=layout, visible=visible & self.visible)


AnyLogBlock = TypeVar("AnyLogBlock", bound=LogBlock)


def in_windows(blocks: Iterable[AnyLogBlock], window: int) -> Iterator[AnyLogBlock]:
    """Yield the epochs in blocks of whole windows; only a segment's last window may be shorter.

    A window is ``window`` epochs long. If ``blocks`` raises a LogError, the epochs before the error
    are yielded first. Blocks of different segments are not joined.
    """
    waiting: list[AnyLogBlock] = []
    count = 0
    try:
        for block in blocks:
            if waiting and block.segment != waiting[0].segment:
                yield block.joined(waiting)
                waiting = []
                count = 0
            waiting.append(block)
            count += len(block)
            if count >= window:
                joined = block.joined(waiting)
                whole = count // window * window
                yield joined.part(slice(whole))
                count -= whole
                waiting = [joined.part(slice(whole, None))] if count else []
    except LogError:
        if waiting:
            yield waiting[-1].joined(waiting)
        raise
    if waiting:
        yield waiting[-1].joined(waiting)


def read_log(
    path: Path,
    scene: Scene,
    epochs_per_block: int = 4096,
    odometry: bool = True,
    limits: bool = True,
    partial: bool = False,
    snr_db: float | None = None,
    clock: bool = False,
) -> Iterator[LogBlock]:
    """Read the epochs of a log, ``epochs_per_block`` at a time; the last block may be shorter.

    Angles are in the frame of the map. Angles of arrival give the direction from the anchor to the
    user, angles of departure the azimuth from the user to the anchor (a figure: docs/data.md).

    If the log is damaged, every complete epoch before the damaged row is yielded before the error.
    The epoch just before the damaged row is complete if the damaged row has a later time. If this
    time is earlier or unreadable, the epoch is complete only if every anchor has a row in it.

    Args:
        path: CSV (``.csv``, ``.csv.gz``) or Parquet (``.parquet``, needs the extra `data`).
        scene: scene whose anchors were measured.
        epochs_per_block: number of epochs in a block.
        odometry: False to ignore columns of odometry. Otherwise the blocks' layout has odometry
            if the log has it.
        limits: whether to refuse values beyond physical limits, and to wrap angles; False to
            diagnose a log.
        partial: whether a link may lack some of its values, in some epochs or everywhere, and
            any anchor may have the Doppler shift.
        snr_db: SNR to assume for links without an SNR.
        clock: whether the user's clock has an unknown offset; the blocks' layout then has a clock.

    Raises:
        LogError: the file is not a log, or lacks a column (raised at once); a row is damaged (the
            message names file, row, column, what was found and what was expected); or the log has
            no row or no measurement (raised at the end).
        ValueError: ``epochs_per_block`` is less than 1.
        OSError: the file can't be read.
    """
    if epochs_per_block < 1:
        raise ValueError(f"epochs_per_block: found {epochs_per_block}, expected at least 1")
    log = open_log(path, scene.hz_per_mps, odometry, partial=partial)
    if partial:
        require_noise(log, snr_db)
    if clock:
        log = with_clock(log)
    layout = Layout(len(scene.anchors_m), "speed" in log.columns, partial, clock)
    tables = whole_epochs(log, layout.anchors, limits)
    blocks = (block_of(table, scene, layout, limits, snr_db) for table in tables)
    return (
        windows.part(slice(first, first + epochs_per_block))
        for windows in in_windows(_require_measurements(path, blocks), epochs_per_block)
        for first in range(0, len(windows), epochs_per_block)
    )


def with_clock(log: LogFile) -> LogFile:
    """Mark that a log's ranges contain an offset of the user's clock; refuse a log without ranges.

    Ranges from round-trip times don't count, because they do not contain the offset.
    """
    ranges = log.columns.get("toa")
    if ranges is None or ranges.name.startswith("rtt"):
        problem = "no range" if ranges is None else f"round-trip times ({ranges.name})"
        raise LogError(
            f"{log.path}: clock: found the setting 'offset', but the log has {problem}; expected "
            "one-way times or ranges, such as toa_s, or the setting 'synchronized'"
        )
    return replace(log, clock=True)


def require_noise(log: LogFile, snr_db: float | None) -> None:
    """Refuse an infinite SNR, and measurements with neither a standard deviation nor an SNR."""
    if snr_db is not None:
        if not math.isfinite(snr_db):
            raise LogError(f"snr: found {snr_db} dB, expected a finite number")
        return
    for quantity in (*ROW_QUANTITIES, STATION, BODY) if "snr" not in log.columns else ():
        if quantity in log.columns and SIGMA_OF[quantity] not in log.columns:
            own = next(iter(QUANTITIES[SIGMA_OF[quantity]].columns))
            raise LogError(
                f"{log.path}: columns: found {log.columns[quantity].name} without its noise, "
                f"expected {own} or snr_db, or --snr DB for all links"
            )


def _require_measurements(path: Path, blocks: Iterable[LogBlock]) -> Iterator[LogBlock]:
    """Yield the blocks; raise an error after the last one if none had a measurement."""
    epochs = 0
    incomplete = 0
    measured = False
    for block in blocks:
        epochs = epochs + len(block)
        incomplete = incomplete + int(block.incomplete.sum())
        measured = measured or bool(block.visible.any())
        yield block
    if not measured:
        raise LogError(
            f"{path}: found {epochs} epochs without a measurement, and {incomplete} incomplete "
            "links (or other groups of values), expected at least one measurement"
        )


def places(layout: Layout) -> dict[str, tuple[int, int]]:
    """Return the place of every quantity in an array that contains all numbers of an epoch.

    The array contains the values that the layout lists, their standard deviations, the SNRs (L,)
    and the Doppler spread. A place is the index of the first anchor's value and the step to the
    value of the next anchor; the step is 0 if an epoch has only one value of the quantity.
    """
    rows = {quantity: (row, 4) for row, quantity in enumerate(LINK_QUANTITIES)}
    rows["doppler"] = layout.doppler, 0
    sigmas = {SIGMA_OF[of]: (layout.size + row, step) for of, (row, step) in rows.items()}
    if layout.odometry:
        rows |= {"speed": (layout.doppler + 1, 0), "heading": (layout.doppler + 2, 0)}
    more = {"snr": (2 * layout.size, 1), "doppler_spread": (2 * layout.size + layout.anchors, 0)}
    return rows | sigmas | more


def block_of(
    table: Table, scene: Scene, layout: Layout, wrap: bool, snr_db: float | None
) -> LogBlock:
    """Convert the rows of complete epochs to a block."""
    epoch = table.epoch
    links = table.links()
    station = scene.anchors_m[0]
    anchor = table["anchor"].astype(np.int64) - 1
    T = int(epoch[-1]) + 1
    of_doppler = table.first(np.where(np.isnan(table["doppler"]), np.nan, anchor))
    size = layout.size
    of_link = dict(zip(LINK_QUANTITIES, links.T, strict=True))
    if STATION in table.columns:
        arrivals = [
            seen_from_image(links[:, 1], links[:, 2], station, image) for image in scene.anchors_m
        ]
        links[:, 1:3] = np.array(arrivals)[anchor, :, range(len(epoch))]
    time = np.empty(T)
    placed = np.full((T, 2 * size + layout.anchors + 1), np.nan)
    time[epoch] = table["time"]
    for quantity, (first, step) in places(layout).items():
        numbers = of_link[quantity] if quantity in of_link else table[quantity]
        some = np.flatnonzero(~np.isnan(numbers))[::-1]  # in reverse, so the first value is kept
        placed[epoch[some], first + step * anchor[some]] = numbers[some]
    measurement, sigma, snr, spread = np.split(
        placed, [size, 2 * size, 2 * size + layout.anchors], axis=1
    )
    if snr_db is not None:
        snr[np.isnan(snr)] = snr_db
    if wrap:
        wrap_angles(measurement, layout)
    shifted = np.nan_to_num(of_doppler).astype(np.int64)
    visible, incomplete = whole_groups(measurement, np.isfinite(snr), layout)
    if not layout.partial:
        visible[:, layout.anchors] &= shifted == 0
    else:
        lost = without_noise(measurement, sigma, np.isfinite(snr), shifted, layout)
        measurement[lost] = np.nan
        visible, _ = whole_groups(measurement, np.isfinite(snr), layout)
        starts = [group.start for group in layout.groups]
        incomplete = np.logical_or.reduceat(lost, starts, axis=1)
    return LogBlock(
        layout=layout,
        time_s=time,
        measurement=measurement,
        sigma=sigma,
        visible=visible,
        incomplete=incomplete,
        doppler_anchor=shifted,
        snr_db=np.where(np.isnan(snr), -np.inf, snr),
        doppler_spread_hz=np.nan_to_num(spread[:, 0]),
        restarts=np.zeros(T, bool),
        share=table.share,
        whole_columns=all(
            not {quantity, other}.isdisjoint(table.columns)
            for quantity, other in zip(LINK_QUANTITIES, ("", STATION, "", BODY), strict=True)
        ),
    )


class PathEpoch(NamedTuple):
    """The n paths of an epoch; all values were measured, except perhaps the Doppler shift."""

    layout: Layout  # layout of the scene's anchors, with or without odometry
    time_s: float
    measurement: Array  # (n, 5) range (m), three angles (rad), Doppler shift (Hz, or NaN)
    # whether all angles of arrival are angles at the base station. If not, a path that a wall
    # reflected has the angles at the base station's mirror image in the wall
    at_station: bool
    snr_db: Array  # (n,)
    incomplete: int  # number of paths that are left out because some of their values are missing
    doppler_spread_hz: float  # 0 where none was measured
    odometry: Array  # (2,) speed, m/s, and heading, rad; NaN where not measured
    share: float  # share of the file read so far, 0 to 1


def read_paths(path: Path, scene: Scene, odometry: bool = True) -> Iterator[PathEpoch]:
    """Read the epochs of a log of paths, one after the other; see :func:`read_log`.

    A column of anchors is ignored, so that a log with anchor numbers can be read, too.

    Raises:
        LogError: as for :func:`read_log`; also for too many paths in an epoch.
        OSError: the file can't be read.
    """
    log = open_log(path, scene.hz_per_mps, odometry, associated=False)
    layout = Layout(len(scene.anchors_m), "speed" in log.columns)
    measured = False
    epochs = 0
    for table in whole_epochs(log, None, limits=True):
        for epoch in _split(table, layout):
            measured = measured or len(epoch.snr_db) > 0
            epochs = epochs + 1
            yield epoch
    if not measured:
        raise LogError(f"{path}: found no complete path in {epochs} epochs, expected at least one")


def _split(table: Table, layout: Layout) -> Iterator[PathEpoch]:
    """Yield the complete paths of every epoch."""
    snr = table["snr"]
    time = table["time"]
    measurement = np.column_stack([table.links(), table["doppler"]])
    measurement[:, 1:4] = wrapped(measurement[:, 1:4])
    finite = np.isfinite(np.column_stack([measurement[:, :4], snr]))
    whole = finite.all(axis=1)
    some = finite.any(axis=1)
    spread = table.first(table["doppler_spread"])
    speed = table.first(table["speed"])
    heading = table.first(table["heading"])
    odometry = np.column_stack([speed, wrapped(heading)])
    ends = np.searchsorted(table.epoch, np.arange(len(spread)), side="right")
    for epoch, (first, end) in enumerate(pairwise([0, *ends.tolist()])):
        kept = np.flatnonzero(whole[first:end]) + first
        yield PathEpoch(
            layout=layout,
            time_s=float(time[first]),
            measurement=measurement[kept],
            at_station=STATION in table.columns,
            snr_db=snr[kept],
            incomplete=int((some & ~whole)[first:end].sum()),
            doppler_spread_hz=float(np.nan_to_num(spread[epoch])),
            odometry=odometry[epoch],
            share=table.share,
        )
