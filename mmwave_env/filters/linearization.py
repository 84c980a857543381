"""Two linearizations of a measurement at a Gaussian prior: tangent and sigma points.

The prior is x = m + L xi with xi ~ N(0, I), where L is the lower Cholesky factor of the covariance.
Both linearizations express a group of measurements as a linear function of latent variables eta,
the *latents*:

    h(x) = h(m) + mean shift + V eta + noise,   eta = (xi, zeta)

The tangent (EKF) has V = dh/dx L, no mean shift, and no curvature latents zeta. For sigma points at
m + s L_j and m - s L_j, let up and down be the changes of h from m. Then V has the column
(up - down) / 2s for xi_j. If h is curved along L_j, V also has the column up + down for a
curvature latent zeta_j. Let w and bend be the weights in :class:`Latents`. The mean shift is w
times the sum of all columns (up + down). Let cov(zeta) = (w / 2) I + bend w^2 e e', where e is a
vector of ones. Then V cov(eta) V' is exactly the covariance of h over all 2n + 1 points, x in R^n.

Only columns 0 to 2 of L move the position, on which a link (range and angles at an anchor) depends.
So the order of the latents is [xi_0..2, zeta, xi_3..6], and links depend only on the first
3 + len(zeta). If the state includes the range bias of a clock, links depend on this bias, too.
Column 3 of L moves the bias (:func:`factor_of`), so the order is [xi_0..3, zeta, xi_4..7].

Source: Julier and Uhlmann 2004, Sec. IV (scaled sigma points as in van der Merwe 2004). The sigma
points of the cubature filter (Arasaratnam and Haykin 2009) have alpha = 1, beta = 0, kappa = 0. For
textbook forms, see ``tangent``, ``unscented``, ``cubature`` in :mod:`~mmwave_env.filters.textbook`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.models.measurement import Group, Measurement, groups_of
from mmwave_env.numerics.linalg import cholesky, dot, product
from mmwave_env.numerics.numbers import Matrix, Number, Vector


@dataclass(frozen=True)
class Tangent:
    """The first-order expansion at the prior mean, which the extended Kalman filter uses."""

    def latents(self, curved: int, size: int) -> "Latents":
        """Return the moments of the latents; the tangent has no curvature latents."""
        return Latents(0, 0.0, 0.0, size)

    def rows(self, group: Group, L: Matrix, latents: "Latents") -> Matrix:
        """Return V (k, 7): the derivatives of k rows along each column of L."""
        return product(group.jacobian, L)


@dataclass(frozen=True)
class SigmaPoints:
    """Scaled symmetric sigma points (2 n + 1 of them, n = 7, or 8 with a clock).

    Attributes:
        alpha, beta, kappa: the usual parameters. alpha and n + kappa must be positive, and beta at
            least -alpha^2 kappa / n, or else cov(zeta) is no covariance.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def reach(self, size: int) -> float:
        """Return the distance of the points from the mean, as a multiple of the columns of L."""
        return self.alpha * float((size + self.kappa) ** 0.5)

    def latents(self, curved: int, size: int) -> "Latents":
        """Return the moments of the latents, with one curvature latent per curved column."""
        return Latents(curved, 0.5 / self.reach(size) ** 2, self.beta - self.alpha**2, size)

    def rows(self, group: Group, L: Matrix, latents: "Latents") -> Matrix:
        """Return V (k, 7 + curvatures) from central and second differences along columns of L."""
        s = self.reach(len(L))
        columns = list(zip(*L, strict=True))
        first = latents.linear
        curved = columns[: group.curved]
        rest = columns[group.curved :]
        up = [group.change([s * c for c in column]) for column in curved]
        down = [group.change([-s * c for c in column]) for column in curved]
        flat = [0.0] * (latents.curvatures - group.curved)
        rows = []
        for i, gradient in enumerate(group.jacobian):
            pairs = [(u[i], d[i]) for u, d in zip(up, down, strict=True)]
            xi = [(u - d) * (0.5 / s) for u, d in pairs] + [dot(gradient, c) for c in rest]
            rows.append(xi[:first] + [u + d for u, d in pairs] + flat + xi[first:])
        return rows


Linearization = Tangent | SigmaPoints


@dataclass(frozen=True)
class Latents:
    """The moments of the latents eta, in the order that the module's docstring gives."""

    curvatures: int  # number of curvature latents
    weight: float  # w, the weight of an outer sigma point
    bend: float  # beta - alpha^2, weight of the mean shift's outer product with itself
    size: int  # number of components of the state

    @property
    def linear(self) -> int:
        """Return the number of columns of L that links depend on: the first 3; 4 with a clock."""
        return self.size - 4

    @property
    def coupled(self) -> int:
        """Return the number of latents that the links depend on, curvatures included."""
        return self.linear + self.curvatures

    @property
    def variance(self) -> list[float]:
        """Return the variances of eta, without what ``bend`` adds to the variances of zeta."""
        return [1.0] * self.linear + [self.weight / 2] * self.curvatures + [1.0] * 4

    @property
    def precision(self) -> list[list[float]]:
        """Return the inverse covariance of the coupled latents (Sherman-Morrison)."""
        n = self.coupled
        m = self.curvatures
        result = [[float(i == j) for j in range(n)] for i in range(n)]
        if m:
            own = self.weight / 2
            shared = self.bend * self.weight**2
            correction = -shared / own**2 / (1.0 + m * shared / own)
            for i in range(self.linear, n):
                for j in range(self.linear, n):
                    result[i][j] = correction + (1.0 / own if i == j else 0.0)
        return result

    def shift(self, row: Vector) -> Number:
        """Return the mean shift of a row, the weighted sum of its curvatures."""
        return self.weight * sum(row[self.linear : self.coupled], 0.0)


class Prior(NamedTuple):
    """A measurement, linearized at the prior."""

    L: Matrix  # (7, 7) factor of the prior covariance, from :func:`factor_of`
    latents: Latents  # moments of eta
    groups: Sequence[Group]  # groups of the measurement, expanded at the prior mean
    V: Sequence[Matrix]  # per group, (k, 7 + curvatures) coefficients of its rows on eta


def factor_of(P: Matrix) -> Matrix:
    """Return L (n, n) with L L' = P; its rows have the order of the state.

    Without a clock, L is lower triangular. With a clock, P is factored in an order in which the
    range bias follows the position, so that the links depend on the first four columns alone.
    """
    if len(P) == STATE_SIZE:
        return cholesky(P)
    order = [0, 1, 2, STATE_SIZE, *range(3, STATE_SIZE)]
    factor = cholesky([[P[i][j] for j in order] for i in order])
    return [factor[order.index(i)] for i in range(len(P))]


def linearize(
    x: Vector, P: Matrix, measurement: Measurement, linearization: Linearization
) -> Prior:
    """Linearize a measurement at the prior N(x, P); x is (7,), P (7, 7)."""
    L = factor_of(P)
    n = len(P)
    latents = linearization.latents(n - 1 if measurement.layout.odometry else 3, n)
    groups = groups_of(x, measurement)
    return Prior(L, latents, groups, [linearization.rows(group, L, latents) for group in groups])
