"""Statistics of position errors: percentiles, fractions of small errors and protection levels.

The horizontal error is the length of the error in x and y; the vertical error is the absolute value
of the error in z. An error is small if it is at most a certain distance; 3GPP TS 22.261, Table
7.3.2.2-1, states these distances for positioning services.
Covariances P are packed: they are lower triangles, row by row (:mod:`mmwave_env.numerics.linalg`).

A protection level is a bound that an error exceeds with a stated probability, the risk, if the
covariance is right. With position errors e ~ N(0, P), the level at risk r is the distance that |e|
exceeds with probability r. A track has integrity if its errors exceed their levels in at most a
fraction r of epochs (Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation
Systems, 2nd ed., 2013, ch. 17).

Vertically, e has a normal distribution with mean 0, so the level is sigma_z Phi^-1(1 - r/2).
Horizontally, let a >= b be the standard deviations along the axes of the error ellipse of x and y,
and e = (a rho cos t, b rho sin t), where the density of rho and t is rho exp(-rho^2/2) / (2 pi).
Then the level is the distance d with Pr(|e| > d) = r, where

    Pr(|e| > d) = 1/(2 pi) int_0^(2 pi) exp(-d^2 / (2 (a^2 cos^2 t + b^2 sin^2 t))) dt.

This is the exact quantile. The usual level, a sqrt(chi2^-1(1 - r; 2)), is an upper bound, which is
exact only if a = b. (J. W. Craig, MILCOM 1991, has the integral for b = 0.)
"""

from functools import lru_cache

import numpy as np

from mmwave_env.io.files import Json
from mmwave_env.metrics import RISK
from mmwave_env.numerics.ellipses import axes_of
from mmwave_env.numerics.numbers import Array

CONFIDENCE = 0.95  # confidence of the interval "ci95" of :func:`exceedance`
_RATIOS = np.linspace(0.0, 1.0, 1025)  # values of b / a; between them, levels are interpolated
_ANGLES = (np.arange(64) + 0.5) * (np.pi / 128)  # values of t; one quadrant represents all
_HALVINGS = 60


def horizontal_level(P: Array, risk: float) -> Array:
    """Compute horizontal levels (...,), m, from packed P (..., 3 or more) with x, y first."""
    major, minor, _ = axes_of(P)
    ratio = np.divide(minor, major, out=np.zeros_like(major), where=major > 0.0)
    return major * np.interp(ratio, _RATIOS, _multiples(risk))  # type: ignore[no-any-return]


def gaussian_levels(P: Array, risk: float) -> Array:
    """Compute horizontal and vertical levels (..., 2), m, from packed P (..., 6 or more)."""
    from scipy.special import ndtri

    vertical = -ndtri(0.5 * risk) * np.sqrt(np.maximum(P[..., 5], 0.0))
    return np.stack([horizontal_level(P, risk), vertical], axis=-1)


@lru_cache(maxsize=16)
def _multiples(risk: float) -> Array:
    """Compute, by bisection, the level divided by ``a`` for every ratio ``b / a``: (ratios,)."""
    spread = np.cos(_ANGLES) ** 2 + np.outer(_RATIOS**2, np.sin(_ANGLES) ** 2)
    low = np.zeros(len(_RATIOS))
    high = np.full(len(_RATIOS), np.sqrt(-2.0 * np.log(risk)))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        beyond = np.exp(-0.5 * middle[:, None] ** 2 / spread).mean(axis=1)
        low, high = np.where(beyond > risk, [middle, high], [low, middle])
    return high


def exceedance(error: Array, level: Array) -> Json:
    """Count how often errors (n,) exceed their levels (n,); "share" and "ci95" are None if n is 0.

    If an error or its level is NaN, the level counts as exceeded. "share" is the count divided by
    n. "ci95" is the interval of Clopper and Pearson (1934) for the share. It assumes independent
    epochs, but a track's epochs are correlated, so another track's share may well lie outside it.
    """
    from scipy.special import betaincinv  # importing scipy.stats would take 0.4 s longer

    n = len(error)
    if not n:
        return {"exceeded": 0, "share": None, "ci95": None}
    count = int((~(error <= level)).sum())
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = betaincinv(count, n - count + 1, tail) if count else 0.0
    high = betaincinv(count + 1, n - count, 1.0 - tail) if count < n else 1.0
    return {"exceeded": count, "share": count / n, "ci95": [float(low), float(high)]}


SHARES = (0.50, 0.67, 0.80, 0.90, 0.95)  # the percentiles to compute, divided by 100
DISTANCES_M = (0.2, 1.0, 3.0, 10.0)


def horizontal(error: Array) -> Array:
    """Compute lengths (...,) of errors (..., 3) in x and y, m."""
    return np.hypot(error[..., 0], error[..., 1])  # type: ignore[no-any-return]


def error_sizes(error: Array) -> Array:
    """Compute the horizontal and the vertical size (..., 2) of errors (..., 3), m."""
    return np.stack([horizontal(error), np.abs(error[..., 2])], axis=-1)


def percentiles(sizes: Array) -> dict[str, float | None]:
    """Compute percentiles of errors (n,), m, as :func:`numpy.quantile` interpolates them.

    A percentile is None if it is not finite: if n is 0, or if too many errors are NaN.
    """
    largest = np.where(np.isnan(sizes), np.inf, sizes) if sizes.size else [np.nan]
    with np.errstate(invalid="ignore"):  # interpolation between two infinities is invalid
        quantiles = np.quantile(largest, SHARES)
    return {
        f"{100.0 * share:.0f}": float(value) if np.isfinite(value) else None
        for share, value in zip(SHARES, quantiles, strict=True)
    }


class PositionErrors:
    """Horizontal and vertical errors of tracks, and protection levels from the tracks' covariances.

    ``risk`` is the probability for which levels are computed. If the height is known (``planar``),
    there are no vertical errors.
    """

    def __init__(self, risk: float = RISK, planar: bool = False) -> None:
        self.risk = risk
        self._kinds = ("horizontal",) if planar else ("horizontal", "vertical")
        self._parts = [np.empty((2, 0, 2))]  # of each call of add(): sizes and levels (n, 2), m

    def add(self, error: Array, P: Array, factors: Array | float = 1.0) -> None:
        """Add errors (..., 3), m, and packed covariances (..., 6 or more) that begin with x, y, z.

        Gaussian levels are multiplied by ``factors`` (..., 2): see ``levels.py``.
        """
        sizes = error_sizes(error)
        levels = gaussian_levels(P, self.risk) * factors
        self._parts.append(np.stack([sizes, levels]).reshape(2, -1, 2))

    def figures(self) -> dict[str, Json]:
        """Return the statistics of errors and levels that docs/errors.md describes, by kind."""
        sizes, levels = np.concatenate(self._parts, axis=1)
        return {kind: _statistics(sizes[:, i], levels[:, i]) for i, kind in enumerate(self._kinds)}


def _statistics(error: Array, level: Array) -> Json:
    """Return the statistics of errors (n,) of one kind and their levels (n,), m."""
    return {
        "epochs": len(error),
        "percentiles_m": percentiles(error),
        "within_m": {
            f"{limit:g}": float((error <= limit).mean()) if error.size else None
            for limit in DISTANCES_M
        },
        "median_level_m": percentiles(level)["50"],
        **exceedance(error, level),
    }
