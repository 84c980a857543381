"""Means and their 95 % bootstrap intervals, over episodes and over training seeds.

The policies from all training seeds are judged on the same episodes, so their scores are an array
(seeds, episodes). Its complete rows and complete columns are resampled, independently of each other
(Owen 2007). The stratified bootstrap of rliable (Agarwal et al. 2021) would be wrong: it assumes
that each score has its own policy, and would count K policies on n episodes as K n policies.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from mmwave_env.io.files import Json
from mmwave_env.numerics.numbers import Array

RESAMPLES = 4000
BLOCK = 100  # number of resamples that are computed together, to bound the memory


class Interval(NamedTuple):
    """A mean with its 95 % bootstrap interval, whose ends are NaN for a single value."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, figures: Json) -> "Interval":
        """Return the interval that a results file stores."""
        low, high = figures["ci95"] or (float("nan"), float("nan"))
        return cls(figures["mean"], low, high)

    @property
    def json(self) -> Json:
        """Return the interval in the form that results files store."""
        return {"mean": self.mean, "ci95": [self.low, self.high] if self.known else None}

    @property
    def known(self) -> bool:
        """Return whether the mean has an interval."""
        return not np.isnan(self.low)

    def __str__(self) -> str:
        return f"{self.mean:.3f}" + (f" [{self.low:.3f}, {self.high:.3f}]" if self.known else "")


def rounded(interval: Interval) -> str:
    """Return the mean ± half the interval's width, with as many digits as the width justifies."""
    if not interval.known:
        return f"{interval.mean:.3f}"
    half = (interval.high - interval.low) / 2.0
    digits = 3 if half <= 0.0 else min(4, max(0, 1 - math.floor(math.log10(half))))
    return f"{interval.mean:.{digits}f} ± {half:.{digits}f}"


@lru_cache(maxsize=2)
def _resamples(n: int, seed: int = 0) -> list[NDArray[np.uint16]]:
    """Return how often each resample draws each of n episodes or seeds, in blocks (BLOCK, n)."""
    rng = np.random.default_rng(seed)
    share = np.full(n, 1.0 / n)
    return [
        rng.multinomial(n, share, size=BLOCK).astype(np.uint16) for _ in range(RESAMPLES // BLOCK)
    ]


def bootstrap(
    rows: Array | Sequence[Array], figures: Callable[[Array], Array] = np.asarray
) -> list[Interval]:
    """Return means of rows (k, episodes) with 95 % percentile intervals over episodes.

    All rows use the same resamples of the episodes.

    Args:
        rows: values of k quantities, for the same episodes.
        figures: function from means (..., k) to the figures (..., m) to return instead of them.
    """
    values = np.asarray(rows)
    means = figures(values.mean(axis=1))
    low = high = np.full(len(means), np.nan)
    n = values.shape[1]
    if n > 1:
        resampled = np.concatenate([block / n @ values.T for block in _resamples(n)])
        low, high = np.percentile(figures(resampled), [2.5, 97.5], axis=0)
    return [Interval(*row) for row in np.transpose([means, low, high]).tolist()]


def bootstrap_ratio(over: Sequence[Array], under: Sequence[Array]) -> list[Interval]:
    """Return ratios of the row means of two arrays (k, episodes), with 95 % intervals.

    A ratio is NaN if its denominator is 0. Its interval is NaN if any resample's denominator is 0.
    """

    def ratios(means: Array) -> Array:
        above, below = np.split(means, 2, axis=-1)
        return above / np.where(below == 0.0, np.nan, below)

    return bootstrap([*over, *under], ratios)


def few_seeds_factor(seeds: int) -> float:
    """Return the factor by which a percentile interval over few seeds is too narrow.

    Resampling K of K seeds narrows an interval by the factor sqrt((K - 1) / K). Also, percentiles
    assume a normal instead of a t distribution. Without this factor, a 95 % interval over 5 seeds
    would contain the true mean with a probability of only 85 % (Hesterberg 2015).
    """
    if seeds == 1:
        return 1.0  # one seed says nothing about the spread
    return float(np.sqrt(seeds / (seeds - 1.0)) * stdtrit(seeds - 1, 0.975) / ndtri(0.975))


def crossed_bootstrap(scores: Array) -> Interval:
    """Return the mean of scores (seeds, episodes) with its 95 % interval over both axes.

    Before resampling, the deviations of the seeds' means from the mean of all scores are multiplied
    by :func:`few_seeds_factor`. The part of the interval that is due to episodes does not change.
    """
    K, n = scores.shape
    apart = scores.mean(axis=1, keepdims=True) - scores.mean()
    moved = scores + (few_seeds_factor(K) - 1.0) * apart
    means = [
        ((of_seeds / K @ moved) * (of_episodes / n)).sum(axis=1)
        for of_seeds, of_episodes in zip(_resamples(K, 1), _resamples(n), strict=True)
    ]
    low, high = np.percentile(np.concatenate(means), [2.5, 97.5])
    return Interval(float(scores.mean()), float(low), float(high))
