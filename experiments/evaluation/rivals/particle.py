"""A bootstrap particle filter (Gordon, Salmond and Smith 1993; Arulampalam et al. 2002).

Particles move as the radio's UKF mode assumes. Their weights are the likelihoods of measurements
with Student-t noise. Such noise makes outliers less improbable, so the filter needs no gates.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from experiments.evaluation.agents import Estimator
from experiments.evaluation.rivals.noise import DOF, log_density, stated
from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, fill, rows_of
from mmwave_env.filters.pipeline import Pipeline, predict
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site, blank_site, groups_of
from mmwave_env.numerics.linalg import cholesky, pack, unpack
from mmwave_env.numerics.numbers import Array, Index, Matrix, Number, Vector
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import blank_incoming

PARTICLES = 10_000
LEAST_M = 0.001  # its square is added to variances, which are 0 if only one particle has weight
SPREAD = 0.35  # width of the kernel that moves particles, in standard deviations of the cloud
KEPT = (1.0 - SPREAD**2) ** 0.5  # shrinks the cloud; adding the kernel's noise restores its width


class Weighed(NamedTuple):
    """A particle, and the epoch whose measurement determines the weight of the particle."""

    incoming: Epoch
    site: Site
    x: list[Number]  # (7,) state of the particle
    log_likelihood: Number  # log likelihood of the epoch's measurement in this state


@lru_cache(maxsize=8)
def _program(layout: Layout, dof: float) -> Program[Weighed]:
    """Return the compiled program that computes the log likelihoods of particles."""

    def function(w: Weighed) -> Weighed:
        total: Number = 0.0
        groups = groups_of(w.x, stated(w.incoming, w.site, layout))
        degrees = layout.degrees(w.incoming.measured)
        for group, k, visible in zip(groups, degrees, w.incoming.visible, strict=True):
            nis = group.spare_nis
            for residual, variance in zip(group.innovation, group.variance, strict=True):
                nis = nis + residual * residual / variance
            total = total + visible * log_density(nis, k, dof)
        return w._replace(log_likelihood=total)

    site = blank_site(layout)
    blank = blank_incoming(layout).epoch(layout)
    return Program(function, Weighed(blank, site, site.prior_x, 0.0))


class Particles(Estimator):
    """A cloud of particles; its mean and covariance are the belief.

    Resampled particles are moved apart by a kernel that keeps mean and covariance (Musso, Oudjane
    and Le Gland 2001; West 1993), because process noise alone would hardly change their heights.

    Args:
        count: number of particles, at least 2.
        dof: degrees of freedom of the measurement noise; a large number means Gaussian noise.
    """

    def __init__(self, count: int = PARTICLES, dof: float = DOF) -> None:
        self._count = count
        self._dof = dof

    def track(
        self, pipeline: Pipeline, site: Site, epochs: Iterator[Epoch]
    ) -> Iterator[tuple[Vector, Vector]]:
        """Yield means and packed covariances; the prior's mean seeds the random numbers."""
        layout = pipeline.layout
        mode = pipeline.modes[-1]
        n = self._count
        rng = np.random.default_rng(np.array(site.prior_x).view(np.uint32))
        program = _program(layout, self._dof)
        values = np.tile(flatten(site), (n, 1))
        rows = fill(blocks_of(program.start, n), rows_of(program.index.site), values)
        state = BatchState.of(np.empty((n, 1, len(program.blank))), rows)
        io = StepIO.of(n, 1, rows_of(program.index.x), rows_of(program.index.log_likelihood))

        def noise(covariance: Matrix) -> Array:
            return np.array(cholesky(covariance)) @ rng.standard_normal((layout.state_size, n))

        x = np.array(site.prior_x)[:, None] + noise(unpack(site.prior_P, pipeline.known_axes))
        # log weights; a packed covariance
        weight = np.zeros(n)
        kernel = [0.0] * layout.triangle
        for epoch in epochs:
            moved, Q = predict(pipeline, mode, list(x), kernel, 1.0, epoch, site.hz_per_mps)
            x = np.array(moved) + noise(Q)
            io.inputs[:, 0] = x.T
            state.table[:] = flatten(epoch)
            state.epoch[:] = 0
            program.run_on_lanes(state, io)
            weight = weight + io.outputs[:, 0, 0]
            share = np.exp(weight - weight.max())
            share /= share.sum()
            mean = x @ share
            away = x - mean[:, None]
            P = (away * share) @ away.T + LEAST_M**2 * np.eye(len(x))
            yield mean, pack(P)
            few = 1.0 / (share @ share) < 0.5 * n
            kernel = pack(SPREAD**2 * few * P)
            if few:
                x = mean[:, None] + KEPT * away[:, resampled(share, rng)]
                weight = np.zeros(n)


def resampled(share: Array, rng: np.random.Generator) -> Index:
    """Draw indices of particles with probabilities ``share`` (n,), by systematic resampling."""
    places = (np.arange(len(share)) + rng.random()) / len(share)
    return np.minimum(np.searchsorted(np.cumsum(share), places), len(share) - 1)
