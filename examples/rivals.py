"""Rivals of learned policies (docs/rivals.md): ``--policies examples.rivals:NAME``.

Two of them are Kalman updates for noise that receivers misstate: a Student-t and an adaptive one.

The stated variances of every group of measured values (such as a link) are multiplied by an unknown
factor with an inverse gamma distribution. Variational Bayes alternates between the belief and the
factors. If the distribution starts anew in every epoch, the noise is Student-t distributed, and
outliers weigh little (Piché, Särkkä and Hartikainen 2012; Roth, Özkan and Gustafsson 2013). If the
distribution is only slowly forgotten, the filter adapts to the noise (Särkkä and Nummenmaa 2009).

The third is a bootstrap particle filter (Gordon, Salmond and Smith 1993; Arulampalam et al. 2002).
Particles move as the radio's UKF mode assumes. Their weights are the likelihoods of measurements
with Student-t noise. Such noise makes outliers less improbable, so the filter needs no gates.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from experiments.evaluation.agents import Estimator
from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.filters.gating import Gate
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, measurement_of, predict
from mmwave_env.filters.update import Algorithm, Posterior, ekf
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Group, Measurement, Site, groups_of
from mmwave_env.numerics.linalg import cholesky, dot, pack, unpack
from mmwave_env.numerics.numbers import Array, Index, Matrix, Number, Vector, log
from policies import FixedMode

DOF = 3.0  # degrees of freedom of Student-t noise, chosen on tuning seeds
MEMORY = 0.5  # factor on the distributions' parameters in every epoch; tuned like DOF
ITERATIONS = 3
LEAST_VARIANCE = 1e-9  # variance added to a known height, m^2, and to its rate, (m/s)^2
EVERYTHING = Gate(None)


def stated(epoch: Epoch, site: Site, layout: Layout) -> Measurement:
    """Return the measurement of an epoch with the noise that the receiver states."""
    return measurement_of(Mode("as stated"), initial_memory(layout, 1), epoch, site, layout)


def log_density(nis: Number, rows: Number, dof: float) -> Number:
    """Return the log density of Student-t noise, without terms that do not depend on the NIS."""
    return -0.5 * (dof + rows) * log(1.0 + nis / dof)


def adapted(
    x: Vector, P: Matrix, measurement: Measurement, shape: Vector, rate: Vector, base: Algorithm
) -> tuple[list[Posterior], list[Number], list[Number]]:
    """Update a belief and the inverse gamma distributions of the factors on the variances.

    Args:
        x, P, measurement: belief and measurement, as for any :data:`Algorithm`.
        shape, rate: (groups,) parameters of the distributions. The first iteration takes rate /
            shape as the factors.
        base: update for Gaussian noise.

    Returns:
        The posterior of every iteration, and the new parameters.
    """
    widths = measurement.layout.widths
    visible = measurement.visible
    degrees = measurement.layout.degrees(measurement.measured)
    after = [a + 0.5 * v * k for a, v, k in zip(shape, visible, degrees, strict=True)]
    factors = [b / a for a, b in zip(shape, rate, strict=True)]
    posteriors = []
    for _ in range(ITERATIONS):
        of_rows = [factor for factor, k in zip(factors, widths, strict=True) for _ in range(k)]
        variance = [v * factor for v, factor in zip(measurement.variance, of_rows, strict=True)]
        posterior = base(x, P, measurement._replace(variance=variance), EVERYTHING)
        misfits = [misfit(group, posterior.P) for group in groups_of(posterior.x, measurement)]
        new = [b + 0.5 * v * q for b, v, q in zip(rate, visible, misfits, strict=True)]
        factors = [b / a for a, b in zip(after, new, strict=True)]
        posteriors.append(posterior)
    return posteriors, after, new


def misfit(group: Group, P: Matrix) -> Number:
    """Return the expectation of r' R^-1 r for a group's residual r, given the covariance P."""
    total = group.spare_nis  # r includes the difference of a link's two azimuths: its NIS
    for residual, h, variance in zip(group.innovation, group.jacobian, group.variance, strict=True):
        total = total + (residual * residual + dot(h, [dot(row, h) for row in P])) / variance
    return total


def student_t(
    x: Vector,
    P: Matrix,
    measurement: Measurement,
    gate: Gate,
    base: Algorithm = ekf,
    dof: float = DOF,
) -> Posterior:
    """Update a belief, assuming Student-t noise.

    ``gate`` is ignored; it is an argument only so that this function can be a mode's algorithm.
    With many degrees of freedom, the result is about the same as from ``base`` without gates.
    """
    same = [0.5 * dof] * len(measurement.visible)
    (first, *_, last), _, _ = adapted(x, P, measurement, same, same, base)
    likelihood = first.log_likelihood
    degrees = measurement.layout.degrees(measurement.measured)
    for nis, k in zip(first.nis, degrees, strict=True):
        likelihood = likelihood + (0.5 * nis + log_density(nis, k, dof))
    return last._replace(nis=first.nis, accepted=first.accepted, log_likelihood=likelihood)


class StudentImm(FixedMode):
    """The IMM over a radio's EKF and UKF, both with Student-t updates instead of gates."""

    beliefs = "per-mode"

    def __init__(self) -> None:
        super().__init__(0)  # action 0 changes no mode probability

    def bank(self, radio: str) -> Bank:
        """Return the modes of the IMM; each continues for another second with probability 0.95."""
        plain = [replace(mode, gate=None, adaptive=False) for mode in default_modes(radio)]
        heavy = (replace(m, algorithm=partial(student_t, base=m.update)) for m in plain)
        return Bank(tuple(heavy))


class Variational(Estimator):
    """The radio's UKF with an adaptive factor on the noise of every group, instead of gates."""

    at_once = True

    def track(
        self, pipeline: Pipeline, site: Site, epochs: Iterator[Epoch]
    ) -> Iterator[tuple[Vector, Vector]]:
        """Yield means and packed covariances."""
        layout = pipeline.layout
        mode = pipeline.modes[-1]
        x = site.prior_x
        P = site.prior_P
        shape = rate = [0.5 * k / (1.0 - MEMORY) for k in layout.widths]
        for epoch in epochs:
            moved, predicted = predict(pipeline, mode, x, P, 1.0, epoch, site.hz_per_mps)
            shape = [MEMORY * value for value in shape]
            rate = [MEMORY * value for value in rate]
            spread = [list(row) for row in predicted]
            for axis in pipeline.known_axes:  # a variance of exactly 0 would cause a division by 0
                spread[axis][axis] = spread[axis][axis] + LEAST_VARIANCE
            measurement = stated(epoch, site, layout)
            posteriors, shape, rate = adapted(moved, spread, measurement, shape, rate, mode.update)
            x = posteriors[-1].x
            P = pack(posteriors[-1].P)
            yield x, P


PARTICLES = 10_000
LEAST_M = 0.001  # its square is added to variances, which are 0 if only one particle has weight
SPREAD = 0.35  # width of the kernel that moves particles, in standard deviations of the cloud
KEPT = (1.0 - SPREAD**2) ** 0.5  # shrinks the cloud; adding the kernel's noise restores its width


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

        def noise(covariance: Matrix) -> Array:
            return np.array(cholesky(covariance)) @ rng.standard_normal((layout.state_size, n))

        x = np.array(site.prior_x)[:, None] + noise(unpack(site.prior_P, pipeline.known_axes))
        # log weights; a packed covariance
        weight = np.zeros(n)
        kernel = [0.0] * layout.triangle
        for epoch in epochs:
            moved, Q = predict(pipeline, mode, list(x), kernel, 1.0, epoch, site.hz_per_mps)
            x = np.array(moved) + noise(Q)
            weight = weight + self._log_likelihood(x, epoch, site, layout)
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

    def _log_likelihood(self, x: Array, epoch: Epoch, site: Site, layout: Layout) -> Array:
        """Return the log likelihoods (n,) of an epoch's measurement in states x (7, n)."""
        total = np.zeros(x.shape[1])
        groups = groups_of(list(x), stated(epoch, site, layout))
        degrees = layout.degrees(epoch.measured)
        for group, k, visible in zip(groups, degrees, epoch.visible, strict=True):
            nis = group.spare_nis
            for residual, variance in zip(group.innovation, group.variance, strict=True):
                nis = nis + residual * residual / variance
            total += visible * log_density(nis, k, self._dof)
        return total


def resampled(share: Array, rng: np.random.Generator) -> Index:
    """Draw indices of particles with probabilities ``share`` (n,), by systematic resampling."""
    places = (np.arange(len(share)) + rng.random()) / len(share)
    return np.minimum(np.searchsorted(np.cumsum(share), places), len(share) - 1)


# names on the command line
particle = Particles
student_imm = StudentImm
variational = Variational
