"""Protection levels: what an error stays below, but for a stated risk, if a covariance is right.

With position errors e ~ N(0, P), a level at risk r is the distance that |e| exceeds with
probability r. Integrity is whether errors of a track do so no more often (P. D. Groves, Principles
of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., 2013, ch. 17).

Vertically |e| has a normal distribution folded at zero: level = sigma_z Phi^-1(1 - r/2).
Horizontally, let a >= b be the standard deviations along the axes of the ellipse of the 2 x 2
block of P, and e = (a rho cos t, b rho sin t) with rho exp(-rho^2/2) drho dt / (2 pi). Then

    P(|e| > d) = 1/(2 pi) int_0^(2 pi) exp(-d^2 / (2 (a^2 cos^2 t + b^2 sin^2 t))) dt,

which is solved for d: the exact quantile, not its usual upper bound a sqrt(chi2^-1(1 - r; 2)),
which it meets where a = b. (J. W. Craig, MILCOM 1991, has the integral for b = 0.)
"""

from functools import lru_cache
from typing import Any

import numpy as np

from mmwave_env.numerics.arrays import Array

RISK = 1e-3  # that a level leaves, where none is stated
CONFIDENCE = 0.95  # of intervals of shares
_RATIOS = np.linspace(0.0, 1.0, 1025)  # b / a, between which levels are interpolated
_ANGLES = (np.arange(64) + 0.5) * (np.pi / 128)  # of a quarter, which stands for all four
_HALVINGS = 60
_LARGEST_RISK = 0.5


def require_risk(risk: float) -> None:
    """Refuse what is no risk.

    Raises:
        ValueError: it is not above 0, or above a half.
    """
    if not 0.0 < risk <= _LARGEST_RISK:
        raise ValueError(f"risk: found {risk:g}, expected more than 0 and at most {_LARGEST_RISK}")


def horizontal_level(P: Array, risk: float) -> Array:
    """Levels (...,), m, of packed covariances P (..., 3 or more), which begin with x and y."""
    xx, xy, yy = P[..., 0], P[..., 1], P[..., 2]
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    major = np.sqrt(middle + half)
    minor = np.sqrt(np.maximum(middle - half, 0.0))
    ratio = np.divide(minor, major, out=np.zeros_like(major), where=major > 0.0)
    levels: Array = major * np.interp(ratio, _RATIOS, _multiples(risk))
    return levels


def vertical_level(P: Array, risk: float) -> Array:
    """Levels (...,), m, of packed covariances P (..., 6 or more), which begin with the position."""
    from scipy.special import ndtri

    levels: Array = -ndtri(0.5 * risk) * np.sqrt(np.maximum(P[..., 5], 0.0))
    return levels


@lru_cache(maxsize=16)
def _multiples(risk: float) -> Array:
    """(ratios,) d / a for every b / a, by halving an interval that holds it."""
    spread = np.cos(_ANGLES) ** 2 + np.outer(_RATIOS**2, np.sin(_ANGLES) ** 2)
    low, high = np.zeros(len(_RATIOS)), np.full(len(_RATIOS), np.sqrt(-2.0 * np.log(risk)))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        beyond = np.exp(-0.5 * middle[:, None] ** 2 / spread).mean(axis=1)
        low, high = np.where(beyond > risk, [middle, high], [low, middle])
    return high


def exceedance(error: Array, level: Array) -> dict[str, Any]:
    """How often errors (n,) exceed their levels (n,).

    An error or a level that is no number does. The interval is Clopper's and Pearson's (1934) with
    :data:`CONFIDENCE`, for epochs that are independent: those of one track follow each other, and
    the share of another track may well lie outside.

    Returns:
        "exceeded", how many; their "share" and its interval "ci95", None of no epochs.
    """
    from scipy.stats import binomtest

    count, n = int((~(error <= level)).sum()), len(error)
    if not n:
        return {"exceeded": 0, "share": None, "ci95": None}
    interval = binomtest(count, n).proportion_ci(CONFIDENCE, method="exact")
    return {
        "exceeded": count,
        "share": count / n,
        "ci95": [float(interval.low), float(interval.high)],
    }
