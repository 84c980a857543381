"""Metrics of the episodes under way, as running sums: an episode's are known as it ends."""

import math

import numpy as np
from numba.extending import register_jitable

from mmwave_env.metrics import BURN_IN, DIVERGENCE_M, nees_interval
from mmwave_env.numerics.numbers import Array, Index

LENGTH, SQUARED, CHANGE, NEES, INSIDE, LARGEST = range(6)  # sums, and the largest squared error
NONFINITE = 6  # epochs, of all, after which error or NEES was no finite number
SUMS = 7


class Tally:
    """Sums over the epochs that metrics count, one row for each of N environments.

    Args:
        n: number of environments.
        axes: position axes that NEES covers.

    Attributes:
        sums: (n, 7).
        errors: (n, T, 3) the latest position errors, m, in turns; T is enough for a second, or
            for the longest episode.
        second: (n,) epochs in a second: at least one, at most those of the episode.
        interval: (2,) of the NEES of a consistent filter.
    """

    def __init__(self, n: int, axes: int) -> None:
        self.sums, self.errors = np.zeros((n, SUMS)), np.zeros((n, 1, 3))
        self.second, self.interval = np.ones(n, np.int64), np.array(nees_interval(axes))

    def begin(self, places: Index, step_s: Array, epochs: Index) -> None:
        """Start over in some environments, with so many epochs (places,) in steps (places,), s."""
        self.second[places] = np.clip(np.round(1.0 / step_s), 1, epochs)
        self.make_room(int(self.second.max()))

    def make_room(self, epochs: int) -> None:
        """Remember at least so many errors."""
        missing = epochs - self.errors.shape[1]
        if missing > 0:
            self.errors = np.pad(self.errors, ((0, 0), (0, missing), (0, 0)))

    def nonfinite(self, places: Index) -> Index:
        """How many epochs (k,) ended without a finite belief, of whole tracks; for some (k,)."""
        return self.sums[places, NONFINITE].astype(np.int64)  # type: ignore[no-any-return]

    def metrics(self, places: Index, epochs: Index) -> dict[str, Array]:
        """What :func:`~mmwave_env.metrics.accuracy` makes of whole tracks, for some (k,).

        Args:
            places: (k,) the environments.
            epochs: (k,) that they ran.
        """
        sums = self.sums[places]
        counted = np.maximum(epochs - BURN_IN, 1)
        changes = np.maximum(counted - self.second[places], 0)
        return {
            "ate_m": sums[:, LENGTH] / counted,
            "rmse_m": np.sqrt(sums[:, SQUARED] / counted),
            "rpe_m": sums[:, CHANGE] / np.maximum(changes, 1),
            "nees": sums[:, NEES] / counted,
            "in_bounds": sums[:, INSIDE] / counted,
            "divergence_rate": (~(sums[:, LARGEST] <= DIVERGENCE_M**2)).astype(float),
        }


@register_jitable
def count(sums, errors, second, interval, k, x, y, z, nees):  # type: ignore[no-untyped-def]
    """Count epoch ``k`` of an episode, from 0, with its position error (m) and NEES.

    Up to the burn-in an epoch replaces those before: of an episode so short the last one counts.

    Args:
        sums: (7,) of the environment, changed in place.
        errors: (T, 3) of the environment, changed in place.
        second: epochs in a second.
        interval: of the NEES.
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
    if squared > sums[LARGEST] or math.isnan(squared):  # and NaN stays
        sums[LARGEST] = squared
    now = errors[k % second]
    if k >= BURN_IN + second:
        u, v, w = x - now[0], y - now[1], z - now[2]
        sums[CHANGE] += math.sqrt(u * u + v * v + w * w)
    now[0], now[1], now[2] = x, y, z
