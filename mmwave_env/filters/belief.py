"""A Gaussian belief about the state, and scores that compare it with the true position."""

import math
from typing import NamedTuple

from mmwave_env.numerics.linalg import dot, mahalanobis, minus
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Pair, Vector, log, sqrt


class Belief(NamedTuple):
    """A Gaussian belief about the state. Reward functions receive it as an argument.

    Attributes:
        x: (7,) mean: position (m), velocity (m/s), oscillator bias (Hz).
        P: (7, 7) covariance.
        axes: the estimated position components: (0, 1, 2), or (0, 1) on flat terrain.
    """

    x: Numbers
    P: Matrix
    axes: tuple[int, ...] = (0, 1, 2)

    def error(self, truth: Vector) -> Numbers:
        """Return estimated minus true position (3,), meters; ``truth`` starts with the position."""
        return minus(self.x[:3], truth)

    def distance(self, truth: Vector) -> Number:
        """Return the length of the position error, meters."""
        e = self.error(truth)
        return sqrt(dot(e, e))

    def nees(self, truth: Vector) -> Number:
        """Return the position's normalized estimation error squared; ideal mean: ``len(axes)``."""
        return self._whiten(truth)[0]

    def log_density(self, truth: Vector) -> Number:
        """Return the log density (nats) of the true position: a proper scoring rule."""
        nees, determinant = self._whiten(truth)
        return -0.5 * (nees + log(determinant) + len(self.axes) * math.log(2.0 * math.pi))

    def _whiten(self, truth: Vector) -> Pair:
        """Return the value of :meth:`nees` and the determinant of the position covariance."""
        error = self.error(truth)
        P = [[self.P[i][j] for j in self.axes] for i in self.axes]
        return mahalanobis(P, [error[i] for i in self.axes])
