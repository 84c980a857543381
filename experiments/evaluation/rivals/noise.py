"""Kalman updates for noise that receivers misstate: a Student-t and an adaptive update.

The stated variances of every group of measured values (such as a link) are multiplied by an unknown
factor with an inverse gamma distribution. Variational Bayes alternates between the belief and the
factors. If the distribution starts anew in every epoch, the noise is Student-t distributed, and
outliers weigh little (Piché, Särkkä and Hartikainen 2012; Roth, Özkan and Gustafsson 2013). If the
distribution is only slowly forgotten, the filter adapts to the noise (Särkkä and Nummenmaa 2009).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from experiments.evaluation.agents import Estimator
from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.filters.gating import Gate
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, measurement_of, predict
from mmwave_env.filters.update import Algorithm, Posterior, ekf
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Group, Measurement, Site, groups_of
from mmwave_env.numerics.linalg import dot, pack
from mmwave_env.numerics.numbers import Matrix, Number, Vector, log
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
