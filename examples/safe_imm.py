"""SAFE-IMM (Mandaokar and Rinner 2025, arXiv 2511.20294), a rival of the IMM (docs/rivals.md).

An IMM reports the mean of all modes, which lags when the user begins to turn or to brake. SAFE-IMM
reports the most probable mode instead, the winner, if it is probable enough and its position is so
near to the mean that the reported track does not jump. The filters go on as in an IMM.

    mmwave-loc compare --policies examples.safe_imm:SafeImm imm --episodes 200
"""

from collections.abc import Iterator

import numpy as np

from experiments.evaluation.agents import Estimator
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.imm import begin, estimate, imm_epoch
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.measurement import Epoch, Site
from mmwave_env.numerics.numbers import Array, Vector

# Chosen on tuning seeds: the least probability of the winner, and the square of its largest
# distance from the mean in x and y, in standard deviations of the mixture.
PROBABLE = 0.8
NEAR = 0.25


class SafeImm(Estimator):
    """The IMM over a radio's EKF and UKF, which reports the winner if its jump is bounded."""

    at_once = True

    def __init__(self, probable: float = PROBABLE, near: float = NEAR) -> None:
        self._probable = probable
        self._near = near

    def track(
        self, pipeline: Pipeline, site: Site, epochs: Iterator[Epoch]
    ) -> Iterator[tuple[Vector, Vector]]:
        """Yield means and packed covariances."""
        settings = settings_of(Bank(pipeline.modes))
        mixture = begin(pipeline, site.prior_x, site.prior_P)
        for epoch in epochs:
            mixture, _, _ = imm_epoch(pipeline, settings, mixture, epoch, site)
            probability = np.array(mixture.probability)
            x, P = map(stacked, estimate(mixture))
            winners = probability.argmax(axis=0)
            everyone = np.arange(probability.shape[1])
            best_x = np.stack([*map(stacked, mixture.x)])[winners, :, everyone].T
            best_P = np.stack([*map(stacked, mixture.P)])[winners, :, everyone].T
            safe = (probability.max(axis=0) >= self._probable) & (
                distance(best_x - x, P) <= self._near
            )
            yield list(np.where(safe, best_x, x)), list(np.where(safe, best_P, P))


def stacked(numbers: Vector) -> Array:
    """Return k numbers, arrays (n,) or the same for all episodes, as an array (k, n)."""
    return np.array(np.broadcast_arrays(*numbers))


def distance(d: Array, P: Array) -> Array:
    """Return d' P^-1 d (n,) in x and y, given vectors (7, n) and packed covariances (28, n)."""
    xx, xy, yy = P[:3]
    return (d[0] ** 2 * yy - 2.0 * d[0] * d[1] * xy + d[1] ** 2 * xx) / (xx * yy - xy * xy)
