"""Two ways to see a curved measurement from a Gaussian prior: tangent or sigma points.

The prior is x = m + L xi with xi ~ N(0, I) and L the lower Cholesky factor. Either way a
group of measurements becomes linear in *latents*:

    h(x) = h(m) + mean shift + V eta + noise,   eta = (xi, kappa)

The tangent (EKF) has V = dh/dx L and no curvature latents kappa. Sigma points m +- s L_j
give V_j = (up - down) / 2s and, per curved column, one curvature latent with
V_kappa_j = up + down, because the 2n + 1 points' covariance is exactly V cov(eta) V' with
cov(kappa) = (w / 2) I + bend w^2 1 1'. So both filters are one computation.

Only columns 0 to 2 of L move the position, so latents are kept in the order
[xi_0..2, kappa, xi_3..6]: the links depend on the first 3 + len(kappa) alone.

Source: Julier and Uhlmann 2004, Sec. IV (scaled sigma points as in van der Merwe 2004).
The cubature filter (Arasaratnam and Haykin 2009) is alpha = 1, beta = 0, kappa = 0. The textbook
forms, with points and weights, stand in ``tests/filters/textbook.py`` (``tangent``, ``unscented``,
``cubature``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mmwave_env.models.measurement import STATE_SIZE, Group, Measurement, groups_of
from mmwave_env.numerics.linalg import cholesky, dot
from mmwave_env.numerics.numbers import Matrix, Number, Vector


@dataclass(frozen=True)
class Tangent:
    """First-order expansion at the prior mean: the extended Kalman filter's view."""

    def latents(self, curved: int) -> "Latents":
        """Moments of the latents; the tangent has no curvature latents."""
        return Latents(0, 0.0, 0.0)

    def rows(self, group: Group, L: Matrix, latents: "Latents") -> list[list[Number]]:
        """V (k, 7): the Jacobian along each column of L."""
        columns = list(zip(*L, strict=True))
        return [[dot(gradient, column) for column in columns] for gradient in group.jacobian]


@dataclass(frozen=True)
class SigmaPoints:
    """Scaled symmetric sigma points (2 n + 1 of them, n = 7).

    Attributes:
        alpha, beta, kappa: the usual parameters; positive alpha^2 (n + kappa).
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        if not self.alpha > 0.0 or not STATE_SIZE + self.kappa > 0.0:
            raise ValueError(
                f"alpha, kappa: found {self.alpha}, {self.kappa}, expected alpha > 0 and "
                f"kappa > -{STATE_SIZE}"
            )
        spread = self.alpha**2 * (STATE_SIZE + self.kappa)
        if not spread + STATE_SIZE * (self.beta - self.alpha**2) >= 0.0:
            raise ValueError(
                f"beta: found {self.beta}, expected at least "
                f"{self.alpha**2 - spread / STATE_SIZE:g} for alpha {self.alpha} and kappa "
                f"{self.kappa}, or the curvature has no covariance"
            )

    @property
    def reach(self) -> float:
        """Distance of the points from the mean, in columns of L."""
        return self.alpha * float((STATE_SIZE + self.kappa) ** 0.5)

    def latents(self, curved: int) -> "Latents":
        """Moments of the latents with one curvature latent per curved column."""
        weight = 0.5 / self.reach**2
        return Latents(curved, weight, self.beta - self.alpha**2)

    def rows(self, group: Group, L: Matrix, latents: "Latents") -> list[list[Number]]:
        """V (k, 7 + curvatures) from central and second differences along the columns of L."""
        s, k = self.reach, len(group.jacobian)
        columns = list(zip(*L, strict=True))
        odd: list[list[Number]] = [[] for _ in range(k)]
        even: list[list[Number]] = [[] for _ in range(k)]
        for column in columns[: group.curved]:
            up = group.change([s * c for c in column])
            down = group.change([-s * c for c in column])
            for i in range(k):
                odd[i].append((up[i] - down[i]) * (0.5 / s))
                even[i].append(up[i] + down[i])
        rows = []
        for i in range(k):
            linear = [dot(group.jacobian[i], column) for column in columns[group.curved :]]
            xi = odd[i] + linear
            flat = [0.0] * (latents.curvatures - group.curved)
            rows.append(xi[:3] + even[i] + flat + xi[3:])
        return rows


Linearization = Tangent | SigmaPoints


@dataclass(frozen=True)
class Latents:
    """Moments of eta = [xi_0..2, kappa, xi_3..6]."""

    curvatures: int  # number of curvature latents
    weight: float  # w, the weight of an outer sigma point
    bend: float  # weight of the outer product of the mean shift, beta - alpha^2

    @property
    def coupled(self) -> int:
        """Latents that the links depend on: the first 3 + curvatures."""
        return 3 + self.curvatures

    @property
    def variance(self) -> list[float]:
        """Variances of eta, but for the part of kappa that the mean shift carries."""
        return [1.0] * 3 + [self.weight / 2] * self.curvatures + [1.0] * 4

    @property
    def precision(self) -> list[list[float]]:
        """Inverse covariance of the coupled latents (Sherman-Morrison)."""
        n, m = self.coupled, self.curvatures
        result = [[float(i == j) for j in range(n)] for i in range(n)]
        if m:
            own, shared = self.weight / 2, self.bend * self.weight**2
            correction = -shared / own**2 / (1.0 + m * shared / own)
            for i in range(3, n):
                for j in range(3, n):
                    result[i][j] = correction + (1.0 / own if i == j else 0.0)
        return result

    def shift(self, row: Vector) -> Number:
        """Mean shift of a row: the weighted sum of its curvatures."""
        total: Number = 0.0
        for v in row[3 : self.coupled]:
            total = total + v
        return self.weight * total


class Prior(NamedTuple):
    """An epoch as a linearization sees it from the prior."""

    L: Matrix  # (7, 7) lower Cholesky factor of the prior covariance
    latents: Latents  # moments of eta
    groups: Sequence[Group]  # of measurements, seen from the prior mean
    V: Sequence[Matrix]  # per group (k, 7 + curvatures), its rows along eta


def linearize(
    x: Vector, P: Matrix, measurement: Measurement, linearization: Linearization
) -> Prior:
    """The epoch seen from N(x, P); x is (7,), P (7, 7)."""
    L = cholesky(P)
    latents = linearization.latents(6 if measurement.layout.odometry else 3)
    groups = groups_of(x, measurement)
    return Prior(L, latents, groups, [linearization.rows(group, L, latents) for group in groups])
