"""Kalman updates with noise that differs from what the receiver states: Student-t, and adaptive.

The variances of every group of a measurement are the stated ones times an unknown factor that has
an inverse gamma distribution. Variational Bayes iterates between the belief and the factors. With a
distribution that starts anew in every epoch, the noise has a Student-t distribution, and outliers
weigh little (Piché, Särkkä and Hartikainen 2012; Roth, Özkan and Gustafsson 2013). With one that is
slowly forgotten, the filter adapts to its noise (Särkkä and Nummenmaa 2009).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from policies import Policy

DOF = 3.0  # degrees of freedom of Student-t noise, chosen on tuning seeds
MEMORY = 0.5  # share of the adaptive filter's knowledge that is left after an epoch, likewise
ITERATIONS = 3
LEAST_VARIANCE = 1e-9  # of a known height (m^2) and climb
EVERYTHING = Gate(None)


def stated(epoch: Epoch, site: Site, layout: Layout) -> Measurement:
    """Return the measurement of an epoch with the noise that the receiver states."""
    return measurement_of(Mode("as stated"), initial_memory(layout, 1), epoch, site, layout)


def log_density(nis: Number, rows: Number, dof: float) -> Number:
    """Return the log density of Student-t noise, without the terms that do not contain the NIS."""
    return -0.5 * (dof + rows) * log(1.0 + nis / dof)


class Adapted(NamedTuple):
    """The result of an update with unknown factors on the variances of every group."""

    first: Posterior  # with the factors expected before
    posterior: Posterior
    shape: list[Number]  # (groups,) parameters of the inverse gamma distributions
    rate: list[Number]


def adapted(
    x: Vector,
    P: Matrix,
    measurement: Measurement,
    shape: Sequence[Number],
    rate: Sequence[Number],
    base: Algorithm,
    iterations: int = ITERATIONS,
) -> Adapted:
    """Update a belief and the distributions (groups,) of the factors on the variances.

    The ``base`` is the update for Gaussian noise; it runs once per iteration, without gates.
    """
    widths, visible = measurement.layout.widths, measurement.visible
    degrees = measurement.layout.degrees(measurement.measured)
    after = [a + 0.5 * v * k for a, v, k in zip(shape, visible, degrees, strict=True)]
    factors, posteriors = [b / a for a, b in zip(shape, rate, strict=True)], []
    for _ in range(iterations):
        of_rows = [factor for factor, k in zip(factors, widths, strict=True) for _ in range(k)]
        variance = [v * factor for v, factor in zip(measurement.variance, of_rows, strict=True)]
        posterior = base(x, P, measurement._replace(variance=variance), EVERYTHING)
        misfits = [misfit(group, posterior.P) for group in groups_of(posterior.x, measurement)]
        new = [b + 0.5 * v * q for b, v, q in zip(rate, visible, misfits, strict=True)]
        factors = [b / a for a, b in zip(after, new, strict=True)]
        posteriors.append(posterior)
    return Adapted(posteriors[0], posteriors[-1], after, new)


def misfit(group: Group, P: Matrix) -> Number:
    """Return the expected r' R^-1 r of a group's residual r at a belief with covariance P."""
    total = group.spare_nis
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
    """Update a belief with Student-t noise; an algorithm for a mode, which ignores the gate.

    With many degrees of freedom the result is that of the ``base`` without gates.
    """
    same = [0.5 * dof] * len(measurement.visible)
    first, (x, P, *_), *_ = adapted(x, P, measurement, same, same, base)
    likelihood = first.log_likelihood
    degrees = measurement.layout.degrees(measurement.measured)
    for nis, k in zip(first.nis, degrees, strict=True):
        likelihood = likelihood + (0.5 * nis + log_density(nis, k, dof))
    return Posterior(x, P, first.nis, first.accepted, likelihood)


class StudentImm(Policy):
    """The IMM over a radio's EKF and UKF, both with Student-t updates instead of gates."""

    beliefs = "per-mode"

    def bank(self, radio: str) -> Bank:
        """Return the bank for a radio, in which a mode continues with probability 0.95."""
        return Bank(
            tuple(
                replace(m, algorithm=partial(student_t, base=m.update), gate=None, adaptive=False)
                for m in default_modes(radio)
            )
        )

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """Trust no mode (n,)."""
        return np.zeros(len(observation), np.int64)


class Variational(Estimator):
    """The radio's UKF with an adaptive factor on the noise of every group, instead of gates."""

    at_once = True

    def __init__(self, memory: float = MEMORY) -> None:
        if not 0.0 < memory < 1.0:
            raise ValueError(f"memory: found {memory}, expected above 0 and below 1")
        self._memory = memory

    def track(
        self, pipeline: Pipeline, site: Site, epochs: Iterator[Epoch]
    ) -> Iterator[tuple[Vector, Vector]]:
        """Yield means and packed covariances."""
        layout, mode = pipeline.layout, pipeline.modes[-1]
        x, P = site.prior_x, site.prior_P
        shape = rate = [0.5 * k / (1.0 - self._memory) for k in layout.widths]
        for epoch in epochs:
            moved, predicted = predict(pipeline, mode, x, P, 1.0, epoch, site.hz_per_mps)
            shape, rate = ([self._memory * value for value in part] for part in (shape, rate))
            spread = [list(row) for row in predicted]
            for axis in pipeline.known_axes:  # arrays can't be structural zeros
                spread[axis][axis] = spread[axis][axis] + LEAST_VARIANCE
            measurement = stated(epoch, site, layout)
            _, after, shape, rate = adapted(moved, spread, measurement, shape, rate, mode.update)
            x, P = after.x, pack(after.P)
            yield x, P
