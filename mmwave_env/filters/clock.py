"""A user's clock that every epoch draws anew (a *free* clock): only differences of ranges count.

A range is z_l = |p - p_l| + B + noise. If nothing is known about the range bias B, the update with
all ranges of an epoch is the same as the update with their differences (TDoA), whichever anchor is
the reference. Here the range of the reference, the *pivot* l, is used up to define the clock,

    B = z_l - |p - p_l|:   mean y_l = z_l - |x - p_l|,   cov(B, x) = -u' P,   var B = u' P u + R_l

with the unit vector u from anchor l to the user. The belief about the other components stays as it
is, and the other ranges are then ordinary rows, with the usual gates, likelihoods and updates.

No range alone contradicts a free clock, but two ranges may contradict each other, as B cancels:

    T_lm = (y_m - y_l)^2 / ((u_m - u_l)' P (u_m - u_l) + R_l + R_m),

which is chi-square distributed with one degree of freedom. The pivot is the range with which the
others agree best; it has the least sum over m of min(T_lm, c), where c is the 99 % quantile. A
range with T_lm > c is *doubtful*, and its variance is multiplied by (T_lm / c)^2. After k epochs in
which no range agreed with the pivot, the belief may be wrong: then c grows to c (1 + k)^4, and the
ranges that disagree least are believed first.
"""

from functools import reduce
from typing import NamedTuple

from mmwave_env.filters.gating import chi_square_limits
from mmwave_env.models.measurement import NEAREST_M, Measurement, norms
from mmwave_env.numerics.linalg import dot, minus
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Vector, maximum, minimum, where
from mmwave_env.numerics.pytree import select

_QUANTILE = 0.99
_UNSEEN = 1e9  # score of a link without a range


class _Pivot(NamedTuple):
    """A link whose range may define the clock."""

    score: Number  # how much the other ranges disagree with it
    chosen: Numbers  # (L,) 1 for this link, else 0
    y: Number  # the range bias, if this range is right, m
    u: Vector  # (3,) unit vector from the anchor to the user
    variance: Number
    T: Numbers  # (L,) disagreements with the ranges of all links


class ClockSet(NamedTuple):
    """The belief and the measurement after the pivot has defined the clock."""

    x: Numbers  # (8,)
    P: Matrix  # (8, 8)
    measurement: Measurement  # without the pivot's range, with more noise in doubtful ranges
    pivot: Numbers  # (L,) 1 for the pivot, else 0
    doubt: Numbers  # (L,) T of doubtful ranges, 0 for others


def set_clock(x: Vector, P: Matrix, m: Measurement, lockout: Number) -> ClockSet:
    """Let the range that most others agree with define the clock; doubt those that do not agree.

    Args:
        x, P: predicted mean (8,) and covariance (8, 8), in which nothing is known about the clock.
        m: the measurement, of a partial layout.
        lockout: number of epochs in a row in which no link passed its gate.
    """
    links = range(m.layout.anchors)
    has_range = [m.visible[a] * m.measured[4 * a] for a in links]
    limit = chi_square_limits(_QUANTILE)[0]
    pivot = _pivot(x, P, m, has_range, limit)
    some = sum(pivot.chosen[1:], pivot.chosen[0])  # 1 if there is a range, else 0
    Pu = [dot(row[:3], pivot.u) for row in P]
    cross = [0.0 - some * c for c in Pu[:-1]]
    own = some * (dot(pivot.u, Pu[:3]) + pivot.variance) + (1.0 - some) * P[-1][-1]
    patience = (1.0 + lockout) * (1.0 + lockout)
    variance = list(m.variance)
    measured = list(m.measured)
    doubt = []
    for a in links:
        T = pivot.T[a] * has_range[a] * some
        excess = T / (limit * patience * patience)
        variance[4 * a] = variance[4 * a] * where(excess > 1.0, excess * excess, 1.0)
        measured[4 * a] = measured[4 * a] * (1.0 - pivot.chosen[a])
        doubt.append(where(T > limit, T, 0.0))
    return ClockSet(
        [*x[:-1], some * pivot.y + (1.0 - some) * x[-1]],
        [*([*row[:-1], c] for row, c in zip(P[:-1], cross, strict=True)), [*cross, own]],
        m._replace(variance=variance, measured=measured),
        pivot.chosen,
        doubt,
    )


def _pivot(x: Vector, P: Matrix, m: Measurement, has_range: Vector, limit: float) -> _Pivot:
    """Return the link whose range the ranges of the other links agree with best."""
    y = []
    u = []
    for a, anchor in enumerate(m.anchors):
        d = minus(x[:3], anchor)
        distance = norms(d)[1]
        y.append(m.z[4 * a] - distance)
        u.append([component / maximum(distance, NEAREST_M) for component in d])
    variance = m.variance[: m.layout.doppler : 4]
    T: list[Numbers] = [[0.0] * len(y) for _ in y]
    for i in range(len(y)):
        for j in range(i):
            g = minus(u[i], u[j])
            e = y[i] - y[j]
            spread = dot(g, [dot(row[:3], g) for row in P[:3]])
            T[i][j] = T[j][i] = e * e / (spread + variance[i] + variance[j])
    pivots = []
    for a in range(len(y)):
        chosen: Numbers = [0.0] * len(y)
        chosen[a] = has_range[a]
        score = dot(has_range, [minimum(value, limit) for value in T[a]])
        score = where(has_range[a] > 0.5, score, _UNSEEN)
        pivots.append(_Pivot(score, chosen, y[a], u[a], variance[a], T[a]))

    def better(best: _Pivot, pivot: _Pivot) -> _Pivot:
        return select(pivot.score < best.score, pivot, best)

    return reduce(better, pivots)
