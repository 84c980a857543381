"""Records of an episode that are used when it ends: sums for metrics, and modes for a replay."""

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.metrics import BURN_IN, RISK, Sums, nees_interval, running_summary
from mmwave_env.numerics.numbers import Array, Index

# columns of the sums: the fields of :class:`~mmwave_env.metrics.Sums` from ``distance`` on
LENGTH, SQUARED, CHANGE, NEES, INSIDE, LARGEST = range(6)
NONFINITE = 6  # column: number of epochs, burn-in included, whose error or NEES is not finite
SUMS = 7

# The horizontal protection level is the error that is exceeded with probability RISK. Its square,
# divided by the variance along the longer axis of the error ellipse, lies between these numbers:
# NARROWEST if the shorter axis is 0, WIDEST if both axes are equal.
NARROWEST = NormalDist().inv_cdf(0.5 * RISK) ** 2
WIDEST = -2.0 * math.log(RISK)
# for exceeds(): number of angles per quadrant, smallest variance (m^2)
ANGLES = 16
LEAST = 1e-12


class Counts(NamedTuple):
    """The records of n environments."""

    sums: Array  # (n, 7)
    errors: Array  # (n, T, 3) ring buffer of the latest position errors, m
    second: Index  # (n,) number of epochs in a second, from 1 to the length of the episode
    interval: Array  # (2,) interval that contains 95 % of a consistent filter's NEES
    # (epochs, n) mode in each epoch of the current episode, in the smallest type that can hold it;
    # (0, n) if episodes are not replayed
    modes: NDArray[np.unsignedinteger]


class Tally:
    """Records of episodes: sums over the epochs that count in the metrics, and chosen modes.

    Args:
        n: number of environments.
        axes: number of position axes that NEES covers.
        replayed: whether to record the modes of episodes, for replays.
        actions: number of different actions, which are recorded as modes.

    Attributes:
        counts: the records; the buffer of errors covers a second, but at most the whole episode.
    """

    def __init__(self, n: int, axes: int, replayed: bool = False, actions: int = 1) -> None:
        self._replayed = replayed
        interval = np.array(nees_interval(axes))
        modes = np.zeros((0, n), np.min_scalar_type(actions))
        sums = np.zeros((n, SUMS))
        errors = np.zeros((n, 1, 3))
        second = np.ones(n, np.int64)
        self.counts = Counts(sums, errors, second, interval, modes)

    def begin(self, places: Index, step_s: Array, epochs: Index) -> None:
        """Start k episodes, given their seconds per epoch (k,) and their numbers of epochs (k,)."""
        second = self.counts.second
        second[places] = np.clip(np.round(1.0 / step_s), 1, epochs)
        errors = self.counts.errors
        modes = self.counts.modes
        missing = max(0, second.max() - errors.shape[1])
        errors = np.pad(errors, ((0, 0), (0, missing), (0, 0)))
        if self._replayed:
            modes = np.pad(modes, ((0, max(0, epochs.max(initial=0) - len(modes))), (0, 0)))
        self.counts = self.counts._replace(errors=errors, modes=modes)

    def nonfinite(self, places: Index) -> Index:
        """Return, for environments (k,), how many epochs (k,) have a non-finite error or NEES."""
        return self.counts.sums[places, NONFINITE].astype(np.int64)  # type: ignore[no-any-return]

    def metrics(self, places: Index, epochs: Index) -> dict[str, Array]:
        """Return the running metrics of some environments (k,), by name.

        Args:
            places: (k,) environments.
            epochs: (k,) number of epochs that each environment ran.
        """
        counted = np.maximum(epochs - BURN_IN, 1)
        changes = np.maximum(counted - self.counts.second[places], 0)
        return running_summary(Sums(counted, changes, *self.counts.sums[places, :NONFINITE].T))


@register_jitable
def count(counts, e, k, x, y, z, nees):  # type: ignore[no-untyped-def]
    """Count epoch ``k`` (counted from 0) of an episode, with its position error (m) and NEES.

    Each of the first BURN_IN + 1 epochs starts the sums anew, so the burn-in (the first BURN_IN
    epochs) does not count. An episode that ends in the burn-in is scored by its last epoch.

    Args:
        counts: a :class:`Counts`, changed in place.
        e: index of the environment.
    """
    sums = counts.sums[e]
    errors = counts.errors[e]
    second = counts.second[e]
    if k <= BURN_IN:
        for i in range(NONFINITE):
            sums[i] = 0.0
    if k == 0:
        sums[NONFINITE] = 0.0
    squared = x * x + y * y + z * z
    if not (math.isfinite(squared) and math.isfinite(nees)):
        sums[NONFINITE] += 1.0
    sums[LENGTH] += math.sqrt(squared)
    sums[SQUARED] += squared
    sums[NEES] += nees
    if counts.interval[0] <= nees <= counts.interval[1]:
        sums[INSIDE] += 1.0
    if squared > sums[LARGEST] or math.isnan(squared):  # once NaN, it stays NaN
        sums[LARGEST] = squared
    now = errors[k % second if second > 1 else 0]  # no slow division if epochs last 1 s
    if k >= BURN_IN + second:
        u = x - now[0]
        v = y - now[1]
        w = z - now[2]
        sums[CHANGE] += math.sqrt(u * u + v * v + w * w)
    now[0] = x
    now[1] = y
    now[2] = z


@register_jitable
def exceeds(x, y, xx, xy, yy):  # type: ignore[no-untyped-def]
    """Return 1.0 if a horizontal error exceeds its protection level, or is NaN; else 0.0.

    The error (x, y), m, with covariance (xx, xy, yy), m^2, exceeds the level if larger errors have
    a probability below RISK. Most errors are so small or so large that this probability need not be
    integrated; :mod:`mmwave_env.localization.position_errors` explains the integral.
    """
    squared = x * x + y * y
    middle = 0.5 * (xx + yy)
    slope = 0.5 * (xx - yy)
    half = math.sqrt(slope * slope + xy * xy)
    if squared <= NARROWEST * (middle + half):
        return 0.0
    if squared > WIDEST * (middle + half):
        return 1.0
    larger = 0.0
    for i in range(ANGLES):
        turn = (i + 0.5) * (math.pi / ANGLES)  # twice the angle to the longer axis
        larger += math.exp(-0.5 * squared / max(middle + half * math.cos(turn), LEAST))
    return 0.0 if larger >= RISK * ANGLES else 1.0
