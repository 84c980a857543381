"""The layout of the state and of a measurement vector: which quantity is in which row.

The measurement vector contains, for each anchor l = 1..L, a *link* of four rows [range, azimuth and
elevation of arrival, azimuth of departure]; then the Doppler shift; then, optionally, odometry
[speed, heading] (paper, Sec. II-B).

Each *group* of rows (a link, the Doppler shift, the odometry) is gated separately. A group is
present or missing as a whole, except in a *partial* layout, in which single rows may be missing,
and in which the Doppler shift may belong to any anchor instead of anchor 1.

If the user's *clock* is not synchronized, the state has an eighth component, the range bias B: the
clock's offset times the speed of light. Every measured range contains B.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mmwave_env.io.lookup import choose, quoted
from mmwave_env.numerics.numbers import PI, Array, Index, Mask, Number, Vector, where

STATE = ("px", "py", "pz", "vx", "vy", "vz", "b")  # m, m/s, Hz
STATE_SIZE = len(STATE)
LINK = ("range_m", "aoa_azimuth_rad", "aoa_elevation_rad", "aod_azimuth_rad")
# Quantities that a receiver may measure: the four rows of every link, and the Doppler shift.
MEASUREMENTS = ("range", "azimuth", "elevation", "departure", "doppler")
CLOCKS = {  # states of the user's clock
    "synchronized": "in step with the anchors' clocks",
    "offset": "ahead of or behind the anchors' clocks, by an unknown time that drifts",
    "free": "ahead or behind by another time in each epoch: only differences of ranges count",
}
_HORIZONTAL = {"range", "azimuth", "departure"}  # a horizontal position needs one or more


@dataclass(frozen=True)
class Layout:
    """The layout of a measurement vector: which quantity is in which row.

    Attributes:
        anchors: number of anchors L >= 1, of which the first is the physical gNB.
        odometry: whether two rows of odometry follow the Doppler shift.
        partial: whether single rows of a group may be missing, and the Doppler shift may belong to
            any anchor; otherwise groups are present or missing as a whole.
        clock: state of the user's clock, one of :data:`CLOCKS`.
    """

    anchors: int = 3
    odometry: bool = False
    partial: bool = False
    clock: str = "synchronized"

    @property
    def has_bias(self) -> bool:
        """Return whether the state includes the range bias of the user's clock."""
        return self.clock != "synchronized"

    @property
    def state_size(self) -> int:
        """Return the number of components of the state: 7, or 8 with a range bias."""
        return STATE_SIZE + self.has_bias

    def bias_drive(self, hz_per_mps: Number) -> Number | None:
        """Return f_c / c, by which the oscillator drives the range bias; None if it is free."""
        return None if self.clock == "free" else hz_per_mps

    @property
    def triangle(self) -> int:
        """Return the number of entries of the packed covariance: 28, or 36 with a range bias."""
        return self.state_size * (self.state_size + 1) // 2

    @property
    def size(self) -> int:
        """Return the number of rows: 4 L + 1, and 2 more with odometry."""
        return 4 * self.anchors + 1 + 2 * self.odometry

    @property
    def doppler(self) -> int:
        """Return the row of the Doppler shift."""
        return 4 * self.anchors

    @property
    def ranges(self) -> slice:
        """Return the rows of the ranges of all links."""
        return slice(0, self.doppler, 4)

    def link(self, anchor: int) -> slice:
        """Return the rows of the link of an anchor; anchors are counted from 0."""
        return slice(4 * anchor, 4 * anchor + 4)

    @cached_property
    def groups(self) -> list[slice]:
        """Return the rows of each group, in order: links, Doppler, odometry."""
        rows = [self.link(a) for a in range(self.anchors)]
        rows.append(slice(self.doppler, self.doppler + 1))
        if self.odometry:
            rows.append(slice(self.doppler + 1, self.doppler + 3))
        return rows

    @cached_property
    def starts(self) -> list[int]:
        """Return the first row of each group."""
        return [rows.start for rows in self.groups]

    @cached_property
    def widths(self) -> list[int]:
        """Return the number of rows of each group."""
        return [rows.stop - rows.start for rows in self.groups]

    def degrees(self, measured: Vector) -> Sequence[Number]:
        """Return the number of measured rows (degrees of freedom) of each group.

        Args:
            measured: (rows,) 1 where a row was measured; empty unless the layout is partial.
        """
        if not self.partial:
            return self.widths
        return [sum(measured[rows][1:], measured[rows][0]) for rows in self.groups]

    @property
    def group_names(self) -> list[str]:
        """Return a name for each group, for tables and messages."""
        names = [*(f"anchor {a + 1}" for a in range(self.anchors)), "Doppler"]
        return [*names, "odometry"] if self.odometry else names

    @cached_property
    def angles(self) -> list[int]:
        """Return the rows that are angles, whose differences wrap."""
        rows = [4 * a + i for a in range(self.anchors) for i in (1, 2, 3)]
        return [*rows, self.doppler + 2] if self.odometry else rows


def measurements_from(names: Sequence[str] | None) -> tuple[str, ...] | None:
    """Return the names in the order of :data:`MEASUREMENTS`; None, which selects all, stays None.

    Raises:
        ValueError: a name is unknown, or nothing measures the horizontal position.
    """
    if names is None:
        return None
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ValueError(
            f"measurements: found {quoted(names)}, expected a list of some of "
            f"{', '.join(MEASUREMENTS)}"
        )
    names = list(names)
    for name in names:
        choose(dict.fromkeys(MEASUREMENTS), name, "measurements")
    if _HORIZONTAL.isdisjoint(names):
        shown = ", ".join(names) or "none"
        raise ValueError(
            f"measurements: found {shown}, expected at least one of range, azimuth and departure, "
            "as the others do not measure the horizontal position"
        )
    return tuple(name for name in MEASUREMENTS if name in names)


def require_clock(clock: str, measurements: Sequence[str] | None = None) -> None:
    """Refuse a ``clock=`` argument that is unknown, or needs ranges that are not measured.

    Raises:
        ValueError: as above.
    """
    choose(CLOCKS, clock, "clock")
    if clock != "synchronized" and measurements is not None and "range" not in measurements:
        raise ValueError(
            f"clock: found {clock} with measurements {', '.join(measurements)}, expected range "
            "among them, as only ranges depend on the clock"
        )


def offered_rows(layout: Layout, measurements: Sequence[str] | None) -> list[bool]:
    """Tell for each row whether it is one of the chosen measurements; odometry counts as chosen.

    Raises:
        ValueError: from :func:`measurements_from`.
    """
    names = measurements_from(measurements) or MEASUREMENTS
    *link, doppler = [name in names for name in MEASUREMENTS]
    rows = [*link * layout.anchors, doppler]
    return [*rows, True, True] if layout.odometry else rows


def sigma_name(name: str) -> str:
    """Return the name of a measurement's standard deviation: "range_sigma_m" for "range_m"."""
    quantity, _, unit = name.rpartition("_")
    return f"{quantity}_sigma_{unit}"


def wrap_angles(measurement: Array, layout: Layout) -> None:
    """Move the angles of measurements (T, rows) into [-pi, pi), in place."""
    rows = layout.angles
    measurement[:, rows] = wrapped(measurement[:, rows])


def wrapped(angles: Number) -> Number:
    """Return angles of any size moved into [-pi, pi); angles in this interval keep their value."""
    moved = (angles + PI) % (2.0 * PI) - PI
    return where((angles >= -PI) & (angles < PI), angles, moved)


def whole_groups(measured: Mask, heard: Mask, layout: Layout) -> Mask:
    """Return a mask (T, groups) of groups that can be used.

    In a partial layout, any row of a group is enough; else all rows and an SNR are needed.

    Args:
        measured: (T, rows) whether a row was measured.
        heard: (T, L) whether a link's SNR is known. The SNR determines the noise of the link's
            rows; the first link's SNR also determines the noise of the Doppler shift.
        layout: layout of the measurements.
    """
    if layout.partial:
        return np.logical_or.reduceat(measured, layout.starts, axis=1)
    whole = np.logical_and.reduceat(measured, layout.starts, axis=1)
    whole[:, : layout.anchors] &= heard
    whole[:, layout.anchors] &= heard[:, 0]
    return whole


def without_noise(
    measurement: Array,
    sigma: Array,
    heard: Mask,
    doppler_anchor: Index,
    layout: Layout,
) -> Mask:
    """Return a mask (T, rows) of measured rows that are lost because their noise is unknown.

    Args:
        measurement: (T, rows), NaN where not measured.
        heard, layout: same as for :func:`whole_groups`.
        sigma: (T, rows) the receiver's own standard deviations, NaN where it states none.
        doppler_anchor: (T,) index, from 0, of the anchor whose Doppler shift was measured.
    """
    known = np.ones(measurement.shape, np.bool_)  # stays True for odometry, which needs no SNR
    known[:, : layout.doppler] = np.repeat(heard, 4, axis=1)
    known[:, layout.doppler] = heard[np.arange(len(heard)), doppler_anchor]
    return np.isfinite(measurement) & ~known & ~np.isfinite(sigma)
