"""Measurement logs, which receivers write: one row per epoch and anchor.

The name of a column (`log_columns.py`) is a quantity and a unit: ``time_s, anchor, toa_s,
aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad, doppler_hz, snr_db``, and optionally
``doppler_spread_hz``, ``speed_mps`` and ``heading_rad`` (odometry). An anchor is given by its
number in the scene. Number 1 is the physical gNB, usually the only anchor with a Doppler shift. A
cell is empty if its value was not measured. A row without any value may be missing. Doppler spread
and odometry belong to the epoch, not to an anchor, so they may be in any row of the epoch.

A log of paths has the same columns without ``anchor``, and one row for each path that a receiver
finds in an epoch. The rows of an epoch are in any order and may include false paths. Every path may
have a Doppler shift, because it is not known yet which path belongs to the base station. A path
needs a range and an azimuth of arrival, and an SNR or standard deviations.
"""

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.log_checks import sound_epochs
from mmwave_env.logs.log_columns import DIFFERENCE, LINK_QUANTITIES, QUANTITIES, SIGMA_OF, STATION
from mmwave_env.logs.log_tables import Arrays, LogError, Table, read_table
from mmwave_env.models.layout import Layout, whole_groups, without_noise, wrap_angles, wrapped
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI, Array, Index, Mask

# Users within 15 degrees of the vertical below or above an anchor are so near to its foot that a
# filter's linearization of the azimuth fails: tracks of users who stood there and left were lost.
STEEP_RAD = math.radians(75.0)


@dataclass(frozen=True, eq=False)
class Log(Arrays):
    """T epochs of a log; values in groups that are not visible are meaningless.

    The layout of a log that was read is partial: single values may be missing.
    """

    layout: Layout  # a measurement's values, in order; groups are links, Doppler shift, odometry
    time_s: Array  # (T,) increasing
    measurement: Array  # (T, rows) m, rad, Hz, m/s; angles in [-pi, pi)
    sigma: Array  # (T, rows) the receiver's own standard deviations; NaN where it states none
    # (T, groups) whether the group can be used: a value with known noise was measured. If the
    # layout is not partial, all values must be measured; links and Doppler shift also need an SNR
    visible: Mask
    # (T, groups) whether a value of the group is left out because its noise is unknown. If the
    # layout is not partial, whether the group is left out because a value or the SNR is missing
    incomplete: Mask
    doppler_anchor: Index  # (T,) index, from 0, of the anchor with the Doppler shift
    snr_db: Array  # (T, L); -inf (no signal) where no SNR was measured
    doppler_spread_hz: Array  # (T,); 0 where none was measured
    line: Index  # (T,) number, in the file, of each epoch's first row; the number of a CSV line
    # (T,) whether the association of paths with anchors began a new track here, so that the filters
    # must begin one, too. Always False in a log with anchor numbers
    restarts: Mask
    columns: frozenset[str] = frozenset()  # names of the columns that were read
    # what is damaged after these epochs; None if the whole log is sound
    damage: LogError | None = None

    @property
    def visible_links(self) -> Mask:
        """Return ``visible`` of the links alone (T, L)."""
        return self.visible[:, : self.layout.anchors]

    @property
    def links(self) -> Array:
        """Return the links (T, L, 4) of the measurement."""
        return self.measurement[:, : self.layout.doppler].reshape(-1, self.layout.anchors, 4)

    def whole(self) -> "Log":
        """Return the log in the plain (not partial) layout; incomplete groups are not visible."""
        layout = replace(self.layout, partial=False)
        whole = whole_groups(np.isfinite(self.measurement), np.isfinite(self.snr_db), layout)
        incomplete = self.incomplete | (self.visible & ~whole)
        whole[:, layout.anchors] &= self.doppler_anchor == 0
        return replace(self, layout=layout, visible=whole & self.visible, incomplete=incomplete)

    def without_steep_angles(self) -> "Log":
        """Return the log without the angles of links that are nearly vertical.

        They are kept in epochs in which no other anchor has an azimuth.
        """
        azimuths = self.visible_links & np.isfinite(self.links[..., 1])
        several = azimuths.sum(axis=1, keepdims=True) > 1
        steep = several & (abs(self.links[..., 2]) > STEEP_RAD)
        angles = np.zeros_like(self.measurement, np.bool_)
        angles[:, self.layout.angles[: 3 * self.layout.anchors]] = np.repeat(steep, 3, axis=1)
        measurement = np.where(angles, np.nan, self.measurement)
        visible = whole_groups(np.isfinite(measurement), np.isfinite(self.snr_db), self.layout)
        return replace(self, measurement=measurement, visible=visible & self.visible)


def read_log(
    path: Path,
    scene: Scene,
    odometry: bool = True,
    limits: bool = True,
    snr_db: float | None = None,
    clock: str = "synchronized",
) -> Log:
    """Read the epochs of a log; if it is damaged, the complete epochs before the damaged row.

    Angles are in the frame of the map. Angles of arrival give the direction from the anchor to the
    user, angles of departure the azimuth from the user to the anchor (a figure: docs/data.md).

    The epoch just before a damaged row is complete if the damaged row has a later time. If this
    time is earlier or unreadable, the epoch is complete only if every anchor has a row in it.

    Args:
        path: CSV (``.csv``, ``.csv.gz``) or Parquet (``.parquet``, needs the extra `data`).
        scene: scene whose anchors were measured. Its corrections, ``bearing_deg`` and
            ``range_offset_m``, are applied.
        odometry: False to ignore columns of odometry. Otherwise the layout has odometry if the log
            has it.
        limits: whether to refuse values beyond physical limits, and to wrap angles; False to
            diagnose a log.
        snr_db: SNR to assume for links without an SNR.
        clock: state of the user's clock, one of :data:`~mmwave_env.models.layout.CLOCKS`.

    Returns:
        The log. If a row is damaged, ``damage`` is the error, which names file, row, column, what
        was found and what was expected.

    Raises:
        LogError: the file is not a log, or lacks a column; or it has no measurement before its end
            or its first damaged row.
        OSError: the file can't be read, or needs more memory than there is.
    """
    table = read_table(path, scene, snr_db=snr_db, clock=clock, odometry=odometry)
    table, damage = sound_epochs(table, limits)
    log = log_of(table, limits)
    if not len(log):
        raise damage or LogError(f"{path}: found no rows below the header, expected at least one")
    if not log.visible.any():
        raise damage or LogError(
            f"{path}: found {len(log)} epochs without a measurement, and "
            f"{int(log.incomplete.sum())} incomplete links (or other groups of values), expected "
            "at least one measurement"
        )
    if "toa" in table.columns and table.columns["toa"].name.startswith(DIFFERENCE):
        _warn_without_reference(table)
    return replace(log, damage=damage)


def _warn_without_reference(table: Table) -> None:
    """Warn if epochs have time differences, but no reference anchor, whose difference is 0."""
    difference = table["toa"]
    measured = np.unique(table.epoch[~np.isnan(difference)])
    missing = np.setdiff1d(measured, table.epoch[difference == 0.0])
    if len(missing):
        line = table.file.place(table.rows[table.starts[missing[0]]])
        warnings.warn(
            f"{table.file.path}: {table.columns['toa'].name}: found {len(missing)} epochs without "
            f"a reference (the first in {line}), expected a row with 0 for the reference anchor, "
            "whose range is otherwise lost",
            stacklevel=3,
        )


def places(layout: Layout) -> dict[str, tuple[int, int]]:
    """Return the place of every quantity in an array that contains all numbers of an epoch.

    The array contains the values that the layout lists, their standard deviations, the SNRs (L,)
    and the Doppler spread. A place is the index of the first anchor's value and the step to the
    value of the next anchor; the step is 0 if an epoch has only one value of the quantity.
    """
    rows = {quantity: (row, 4) for row, quantity in enumerate(LINK_QUANTITIES)}
    rows["doppler"] = layout.doppler, 0
    sigmas = {SIGMA_OF[name]: (layout.size + row, step) for name, (row, step) in rows.items()}
    if layout.odometry:
        rows |= {"speed": (layout.doppler + 1, 0), "heading": (layout.doppler + 2, 0)}
    more = {"snr": (2 * layout.size, 1), "doppler_spread": (2 * layout.size + layout.anchors, 0)}
    return rows | sigmas | more


def log_of(table: Table, wrap: bool = True, number: Array | None = None) -> Log:
    """Convert the rows of complete epochs to a log; wrap its angles unless ``wrap`` is False.

    If rows are paths, ``number`` (n,) are the numbers of their anchors; NaN for paths of none, of
    which only the values of their epoch are used. Of paths, only anchor 1 has a Doppler shift.
    """
    file = table.file
    layout = file.layout
    epoch = table.epoch
    if number is None:
        number = table["anchor"]
    known = ~np.isnan(number)
    shifts = known if file.associated else number == 1.0
    anchor = np.nan_to_num(number, nan=1.0).astype(np.int64) - 1
    links = table.links(anchor)
    starts = table.starts
    T = len(starts)
    size = layout.size
    of_link = dict(zip(LINK_QUANTITIES, links.T, strict=True))
    placed = np.full((T, 2 * size + layout.anchors + 1), np.nan)
    for quantity, (first, step) in places(layout).items():
        numbers = of_link[quantity] if quantity in of_link else table[quantity]
        used = ~np.isnan(numbers)
        if not QUANTITIES[quantity].per_epoch:
            used &= shifts if quantity in ("doppler", "doppler_sigma") else known
        some = np.flatnonzero(used)[::-1]  # in reverse, so the first value is kept
        placed[epoch[some], first + step * anchor[some]] = numbers[some]
    measurement, sigma, snr, spread = np.split(
        placed, [size, 2 * size, 2 * size + layout.anchors], axis=1
    )
    ranges = sigma[:, layout.ranges]
    np.hypot(ranges, file.scene.offset_sigmas_m, out=ranges)
    if file.snr_db is not None:
        snr[np.isnan(snr)] = file.snr_db
    if wrap:
        wrap_angles(measurement, layout)
    of_doppler = table.first(np.where(shifts & ~np.isnan(table["doppler"]), anchor, np.nan))
    shifted = np.nan_to_num(of_doppler).astype(np.int64)
    heard = np.isfinite(snr)
    lost = without_noise(measurement, sigma, heard, shifted, layout)
    measurement[lost] = np.nan
    visible = whole_groups(np.isfinite(measurement), heard, layout)
    return Log(
        layout=layout,
        time_s=table["time"][starts],
        measurement=measurement,
        sigma=sigma,
        visible=visible,
        incomplete=np.logical_or.reduceat(lost, layout.starts, axis=1),
        doppler_anchor=shifted,
        snr_db=np.where(np.isnan(snr), -np.inf, snr),
        doppler_spread_hz=np.nan_to_num(spread[:, 0]),
        line=table.rows[starts],
        restarts=np.zeros(T, bool),
        columns=frozenset(column.name for column in table.columns.values()),
    )


class PathLog(NamedTuple):
    """The complete paths of a log, among its n rows: range and azimuth of arrival were measured."""

    layout: Layout  # layout of the scene's anchors, with or without odometry
    time_s: Array  # (T,) increasing
    epochs: list[Index]  # (T,) for each epoch, the numbers, from 0, of the rows with its paths
    # (n, 4) range (m) and angles (rad), as the base station would have measured them. An elevation
    # that was not measured is that of a user in the street, a departure opposite to the arrival
    links: Array
    # (n, 4) the receiver's own standard deviations; NaN where it states none, infinite where the
    # value was not measured
    sigma: Array
    snr_db: Array  # (n,) NaN where not measured; then all standard deviations are known
    incomplete: int  # number of paths that are left out because they lack a value or its noise
    table: Table  # the rows
    damage: LogError | None  # what is damaged after these epochs; None if the whole log is sound

    @property
    def at_station(self) -> bool:
        """Tell whether angles of arrival were measured at the base station."""
        return STATION in self.table.columns


def read_paths(
    path: Path, scene: Scene, odometry: bool = True, snr_db: float | None = None
) -> PathLog:
    """Read the epochs of a log of paths; see :func:`read_log`.

    A column of anchors is ignored, so that a log with anchor numbers can be read, too.

    Raises:
        LogError: as for :func:`read_log`; also for too many paths in an epoch.
        OSError: as for :func:`read_log`.
    """
    table = read_table(path, scene, snr_db=snr_db, odometry=odometry, associated=False)
    log = paths_of(*sound_epochs(table, limits=True))
    if not any(map(len, log.epochs)):
        raise log.damage or LogError(
            f"{path}: found no complete path in {len(log.time_s)} epochs, expected at least one"
        )
    return log


def paths_of(table: Table, damage: LogError | None = None) -> PathLog:
    """Return the paths in rows without anchor numbers."""
    file = table.file
    snr_db = table["snr"]
    if file.snr_db is not None:
        snr_db = np.where(np.isnan(snr_db), file.snr_db, snr_db)
    links = table.links(0)
    sigma = np.column_stack([table[SIGMA_OF[quantity]] for quantity in LINK_QUANTITIES])
    missing = np.isnan(links)
    sigma[missing] = np.inf
    known = ~missing[:, :2].any(axis=1) & ~(missing[:, 3] & (STATION in table.columns))
    whole = known & (np.isfinite(snr_db) | ~np.isnan(sigma).any(axis=1))
    some = ~missing.all(axis=1) | np.isfinite(snr_db)
    rise = (file.scene.streets.height_m - file.scene.anchors_m[0, 2]) / links[:, 0]
    links[:, 2] = np.where(missing[:, 2], np.arcsin(np.clip(rise, -1.0, 1.0)), links[:, 2])
    links[:, 3] = np.where(missing[:, 3], links[:, 1] + PI, links[:, 3])
    links[:, 1:] = wrapped(links[:, 1:])
    of_epochs = np.split(np.arange(len(table)), table.starts[1:])
    return PathLog(
        layout=replace(file.layout, partial=not np.isnan(sigma[whole]).all()),
        time_s=table["time"][table.starts],
        epochs=[rows[whole[rows]] for rows in of_epochs],
        links=links,
        sigma=sigma,
        snr_db=snr_db,
        incomplete=int((some & ~whole).sum()),
        table=table,
        damage=damage,
    )
