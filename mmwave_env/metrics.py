"""Metrics of a track: position errors and consistency (paper, Sec. IV).

Tracks and truth are in the same frame, so they are not aligned with each other before they are
compared. ATE, RMSE and RPE equal those of the tool evo (translation part, without alignment).
:meth:`mmwave_env.filters.belief.Belief.nees` computes the NEES of the position. For a consistent
filter and 3 axes, the NEES has the expectation 3, and is in the two-sided chi-square interval
[0.22, 9.35] in 95 % of the epochs. (The paper gates a 3-D NEES at 5.99, the one-sided 95 % quantile
for 2 axes; for 3 axes it is 7.81.)
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mmwave_env.numerics.numbers import Array, Index

BURN_IN = 10  # number of first epochs left out of averages, because the prior still affects them
RISK = 1e-3  # default probability that an error exceeds its bound, the protection level
DIVERGENCE_M = 50.0  # an episode has diverged if its position error exceeds this


def _squared(error: Array) -> Array:
    """Compute the squared length (..., T) of errors (..., T, 3), m^2."""
    x, y, z = (error[..., axis] for axis in range(3))
    return x * x + y * y + z * z


def nees_interval(axes: int = 3) -> tuple[float, float]:
    """Return the two-sided interval that holds a consistent filter's NEES in 95 % of epochs."""
    from scipy.special import chdtri

    tail = (1.0 - 0.95) / 2.0
    return float(chdtri(axes, 1.0 - tail)), float(chdtri(axes, tail))


def scored(epochs: int) -> slice:
    """Return the epochs that averages use: all after the burn-in; if there are none, the last."""
    return slice(min(BURN_IN, epochs - 1), None)


class Sums(NamedTuple):
    """Sums (n,) over the epochs of n tracks after the burn-in."""

    epochs: Index | int  # number of epochs
    changes: Index | int  # number of pairs of epochs that are a second apart
    distance: Array  # length of the position error, m
    squared: Array  # squared length of the position error, m^2
    change: Array  # length of the change of the position error over a second, m
    nees: Array
    inside: Array  # number of epochs with the NEES inside its 95 % interval
    largest: Array  # not a sum: the largest squared error, m^2


class Metric(NamedTuple):
    """A number that describes an episode's track."""

    name: str  # name in results
    header: str  # header of its column in tables
    unit: str
    meaning: str
    # computes the metric; None for the reward, which infos do not contain
    value: Callable[[Sums], Array] | None = None
    info: str = ""  # key in infos, if it differs from the name

    @property
    def described(self) -> str:
        """Return the meaning with its unit."""
        return f"{self.meaning}, {self.unit}" if self.unit else self.meaning


METRICS = {
    metric.name: metric
    for metric in (
        Metric("reward", "reward", "", "mean reward per epoch"),
        Metric(
            "ate_m", "ATE m", "m", "mean position error",
            lambda s: s.distance / s.epochs,
        ),
        Metric(
            "rmse_m", "RMSE m", "m", "root mean square position error",
            lambda s: np.sqrt(s.squared / s.epochs),
        ),
        Metric(
            "rpe_m", "RPE m", "m",
            "mean change of the position error over 1 s (at least one epoch)",
            lambda s: s.change / np.maximum(s.changes, 1),
        ),
        Metric(
            "nees", "NEES", "", "mean NEES of the position",
            lambda s: s.nees / s.epochs,
            "mean_nees",
        ),
        Metric(
            "in_bounds", "in 95 % bounds", "",
            "share of epochs with NEES in its two-sided 95 % interval",
            lambda s: s.inside / s.epochs,
        ),
        Metric(
            "divergence_rate", "diverged", "",
            f"share of episodes with an error above {DIVERGENCE_M:g} m",
            lambda s: (~(s.largest <= DIVERGENCE_M**2)).astype(float),  # also if it is NaN
            "divergence",
        ),
    )
}  # fmt: skip
INFO_KEYS = {m.name: m.info or m.name for m in METRICS.values() if m.value}
TERMS = {  # term -> its header and meaning; the tracking reward is minus the sum of both terms
    "error_term": ("error term", "what position errors cost in the tracking reward, per epoch"),
    "nees_term": ("NEES term", "what the NEES costs in the tracking reward, per epoch"),
}
HEADERS = {name: metric.header for name, metric in METRICS.items()}
HEADERS |= {name: header for name, (header, _) in TERMS.items()}


def summary(
    error: Array, nees: Array, epochs_per_s: float = 1.0, axes: int = 3, reward: Array | None = None
) -> dict[str, Array]:
    """Compute all :data:`METRICS` per episode, without the burn-in.

    Errors (..., T, 3) are estimated minus true positions, m. The NEES (..., T) covers 2 or 3
    position ``axes``. RPE compares epochs that are a second apart. The result contains a mean
    reward only if rewards (..., T) are passed.
    """
    counted = scored(nees.shape[-1])
    nees = nees[..., counted]
    error = error[..., counted, :]
    delta = max(1, round(epochs_per_s))
    change = error[..., delta:, :] - error[..., :-delta, :]
    metrics = running_summary(sums_of(error, nees, change, axes))
    return metrics if reward is None else {"reward": reward[..., counted].mean(axis=-1)} | metrics


def sums_of(error: Array, nees: Array, change: Array, axes: int) -> Sums:
    """Sum up errors (..., T, 3), NEES (..., T) of position ``axes``, and changes (..., pairs, 3).

    All epochs count. The changes are differences of errors, m.
    """
    low, high = nees_interval(axes)
    squared = _squared(error)
    return Sums(
        epochs=nees.shape[-1],
        changes=change.shape[-2],
        distance=np.sqrt(squared).sum(axis=-1),
        squared=squared.sum(axis=-1),
        change=np.sqrt(_squared(change)).sum(axis=-1),
        nees=nees.sum(axis=-1),
        inside=((nees >= low) & (nees <= high)).sum(axis=-1),
        largest=squared.max(axis=-1),
    )


def running_summary(sums: Sums) -> dict[str, Array]:
    """Compute, for each of n tracks, the metrics (n,) that sums determine."""
    return {name: METRICS[name].value(sums) for name in INFO_KEYS}  # type: ignore[misc]
