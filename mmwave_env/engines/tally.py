"""Running sums for the metrics of current episodes, which are then known at an episode's end."""

import math

import numpy as np
from numba.extending import register_jitable

from mmwave_env.metrics import BURN_IN, Sums, nees_interval, running_summary
from mmwave_env.numerics.numbers import Array, Index

# in the order of :class:`~mmwave_env.metrics.Sums`
LENGTH, SQUARED, CHANGE, NEES, INSIDE, LARGEST = range(6)
NONFINITE = 6  # number of epochs, burn-in included, with an error or NEES that is not finite
SUMS = 7


class Tally:
    """Sums over the epochs that metrics count, with one row for each of N environments.

    Args:
        n: number of environments.
        axes: number of position axes that NEES covers.

    Attributes:
        sums: (n, 7) sums.
        errors: (n, T, 3) ring buffer of the latest position errors, m; T epochs cover a second or
            the longest episode.
        second: (n,) number of epochs in a second, from 1 to the length of the episode.
        interval: (2,) interval of the NEES of a consistent filter.
    """

    def __init__(self, n: int, axes: int) -> None:
        self.sums, self.errors = np.zeros((n, SUMS)), np.zeros((n, 1, 3))
        self.second, self.interval = np.ones(n, np.int64), np.array(nees_interval(axes))

    def begin(self, places: Index, step_s: Array, epochs: Index) -> None:
        """Start over in some environments, given their numbers of epochs and their steps, s."""
        self.second[places] = np.clip(np.round(1.0 / step_s), 1, epochs)
        self.make_room(int(self.second.max()))

    def make_room(self, epochs: int) -> None:
        """Make room for at least that number of errors."""
        missing = epochs - self.errors.shape[1]
        if missing > 0:
            self.errors = np.pad(self.errors, ((0, 0), (0, missing), (0, 0)))

    def nonfinite(self, places: Index) -> Index:
        """Return the number (k,) of epochs without a finite belief in some environments (k,)."""
        return self.sums[places, NONFINITE].astype(np.int64)  # type: ignore[no-any-return]

    def metrics(self, places: Index, epochs: Index) -> dict[str, Array]:
        """Return the running metrics of some environments (k,), by name.

        Args:
            places: (k,) environments.
            epochs: (k,) number of epochs that each environment ran.
        """
        counted = np.maximum(epochs - BURN_IN, 1)
        changes = np.maximum(counted - self.second[places], 0)
        return running_summary(Sums(counted, changes, *self.sums[places, :NONFINITE].T))


@register_jitable
def count(sums, errors, second, interval, k, x, y, z, nees):  # type: ignore[no-untyped-def]
    """Count epoch ``k`` of an episode, from 0, with its position error (m) and NEES.

    Up to the burn-in, an epoch replaces earlier epochs: of a shorter episode the last one counts.

    Args:
        sums: (7,) sums of the environment, changed in place.
        errors: (T, 3) errors of the environment, changed in place.
        second: number of epochs in a second.
        interval: (2,) interval of the NEES.
    """
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
    if interval[0] <= nees <= interval[1]:
        sums[INSIDE] += 1.0
    if squared > sums[LARGEST] or math.isnan(squared):  # once NaN, it stays NaN
        sums[LARGEST] = squared
    now = errors[k % second]
    if k >= BURN_IN + second:
        u, v, w = x - now[0], y - now[1], z - now[2]
        sums[CHANGE] += math.sqrt(u * u + v * v + w * w)
    now[0], now[1], now[2] = x, y, z
