"""True positions of a user at any time, interpolated from a recorded track."""

import warnings
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mmwave_env.logs.tum import read_tum
from mmwave_env.numerics.numbers import Array

BRIDGED_S = 1.5  # longest gap that is interpolated: GPS gives a pose per second, sometimes late
TOLERANCE_S = 0.01  # a pose this close in time is used without interpolation, as in the tool evo


class Truth:
    """A track of true positions, from a TUM file.

    Between two poses that are at most ``BRIDGED_S`` apart, the position is on the cubic Hermite
    spline through both. At a pose, the spline has the velocity of the parabola through this
    pose and its neighbors. In longer gaps and beyond the ends of the track, the nearest pose
    is used if it is at most ``TOLERANCE_S`` away; otherwise the position is unknown.

    Raises:
        ValueError, OSError: as for :func:`~mmwave_env.logs.tum.read_tum`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._poses = read_tum(path)

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicHermiteSpline

        slope = velocity_of(*self._poses, BRIDGED_S)
        return CubicHermiteSpline(*self._poses, np.nan_to_num(slope))

    def at(self, time_s: Array) -> Array:
        """Return positions (T, 3), m, at times (T,); NaN where not known."""
        t, p = self._poses
        after = np.searchsorted(t, time_s)
        before = np.maximum(after - 1, 0)
        after = np.minimum(after, len(t) - 1)
        nearest = np.where(time_s - t[before] <= t[after] - time_s, before, after)
        held = np.abs(t[nearest] - time_s) <= TOLERANCE_S
        position = np.where(held[:, None], p[nearest], np.nan)
        step = t[after] - t[before]
        between = (t[before] < time_s) & (time_s < t[after]) & (step <= BRIDGED_S)
        if between.any():
            position[between] = self._spline(time_s[between])
        return position

    def require_match(self, matched: int, time_s: Array) -> None:
        """Compare this file with a log, given its times (T,) and how many have a true position.

        If less than half have one, there is a warning.

        Raises:
            ValueError: none of them has one.
        """
        if 2 * matched >= len(time_s):
            return
        own_s = self._poses.time_s
        problem = (
            f"{self.path}: found a true position for {matched} of the log's {len(time_s)} epochs, "
            f"expected at least half; the log's times are {time_s[0]:.13g} to {time_s[-1]:.13g} s, "
            f"those of this file {own_s[0]:.13g} to {own_s[-1]:.13g} s: are both in seconds "
            f"and by the same clock, and are there gaps of more than {BRIDGED_S:g} s in this file?"
        )
        if not matched:
            raise ValueError(problem)
        warnings.warn(problem, stacklevel=3)


def stretches(time_s: Array, truth: Array, gap_s: float) -> list[slice]:
    """Return runs of two or more epochs with a truth and without a gap longer than ``gap_s``.

    Times (T,) increase; true positions (T, 3), or also velocities (T, 6), are NaN where not known.
    """
    known = np.asarray(np.isfinite(truth).all(axis=1))
    ends = np.flatnonzero(~known[:-1] | ~known[1:] | (np.diff(time_s) > gap_s)) + 1
    return [slice(a, b) for a, b in pairwise([0, *ends.tolist(), len(time_s)]) if b - a > 1]


def velocity_of(time_s: Array, position_m: Array, gap_s: float) -> Array:
    """Compute velocities (T, 3) from parabolas through adjacent epochs; NaN outside stretches."""
    velocity = np.full_like(position_m, np.nan)
    for run in stretches(time_s, position_m, gap_s):
        velocity[run] = np.gradient(position_m[run], time_s[run], axis=0)
    return velocity
