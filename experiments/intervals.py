"""Means and their 95 % bootstrap intervals, over episodes and over training seeds."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RESAMPLES = 4000


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % bootstrap interval."""

    mean: float
    low: float
    high: float

    @property
    def json(self) -> dict[str, Any]:
        """As results files hold it."""
        return {"mean": self.mean, "ci95": [self.low, self.high]}

    def __str__(self) -> str:
        return f"{self.mean:.3f} [{self.low:.3f}, {self.high:.3f}]"


@lru_cache(maxsize=1)
def _resamples(n: int, seed: int) -> NDArray[np.uint16]:
    """How often each of n episodes is drawn (resamples, n)."""
    rng = np.random.default_rng(seed)
    counts = np.empty((RESAMPLES, n), np.uint16)
    for rows in np.split(counts, RESAMPLES // 100):  # int64 at once would be large
        rows[:] = rng.multinomial(n, np.full(n, 1.0 / n), size=len(rows))
    return counts


def _resampled_means(values: Array, seed: int) -> Array:
    """Means (resamples, k) of columns (episodes, k), which share the resamples."""
    n = len(values)
    blocks = np.split(_resamples(n, seed), RESAMPLES // 100)
    return np.concatenate([rows / n @ values for rows in blocks])


def bootstrap(values: Array, seed: int = 0) -> list[Interval]:
    """Means of columns (episodes, k) with 95 % percentile intervals over episodes."""
    low, high = np.percentile(_resampled_means(values, seed), [2.5, 97.5], axis=0)
    columns = zip(values.mean(axis=0), low, high, strict=True)
    return [Interval(float(m), float(a), float(b)) for m, a, b in columns]


def bootstrap_ratio(over: Array, under: Array, seed: int = 0) -> Interval:
    """Ratio of two means over the same episodes, each (episodes,)."""
    means = _resampled_means(np.stack([over, under], axis=1), seed)
    low, high = np.percentile(means[:, 0] / means[:, 1], [2.5, 97.5])
    return Interval(float(over.mean() / under.mean()), float(low), float(high))
