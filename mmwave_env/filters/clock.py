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
range with T_lm > c is *doubtful*, and gets so much more noise that its T falls to c^2 / T_lm: the
more it disagrees, the less it counts, however vague the belief is. After k seconds in which no
range agreed with the pivot, the belief may be wrong: then c grows to c (1 + k)^4, and the ranges
that disagree least are believed first.
"""

from typing import NamedTuple

from mmwave_env.filters.gating import chi_square_limits
from mmwave_env.filters.update import Posterior
from mmwave_env.models.measurement import NEAREST_M, Measurement, norms
from mmwave_env.numerics.linalg import dot, minus, plus
from mmwave_env.numerics.numbers import (
    Matrix,
    Number,
    Numbers,
    Vector,
    log,
    maximum,
    minimum,
    where,
)
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
    S: Numbers  # (L,) variances of the differences to the ranges of all links


class ClockSet(NamedTuple):
    """The belief and the measurement after the pivot has defined the clock."""

    x: Numbers  # (8,)
    P: Matrix  # (8, 8)
    measurement: Measurement  # without the pivot's range, with more noise in doubtful ranges
    pivot: Numbers  # (L,) 1 for the pivot, else 0
    doubt: Numbers  # (L,) T of doubtful ranges, 0 for others
    # sum of ln sqrt(S'/R): S' is the variance of a doubtful difference after its noise grew, R that
    # of its noise before; so a mode's likelihood does not depend on how vague its belief is
    log_inflation: Number

    def judged(self, posterior: Posterior) -> Posterior:
        """Return a posterior whose NIS, verdicts and likelihood count the ranges used up here.

        The pivot's range has no innovation; its expected NIS is 1. A doubtful range, whose
        innovation more noise made small, is rejected, and has the likelihood of a range that
        disagrees as much with an exact belief.
        """
        links = len(self.pivot)
        nis = plus(posterior.nis[:links], plus(self.pivot, self.doubt))
        accepted = [
            where(T > 0.0, 0.0, used)
            for T, used in zip(self.doubt, posterior.accepted[:links], strict=True)
        ]
        return posterior._replace(
            nis=[*nis, *posterior.nis[links:]],
            accepted=[*accepted, *posterior.accepted[links:]],
            log_likelihood=posterior.log_likelihood
            + self.log_inflation
            - 0.5 * sum(self.doubt, 0.0),
        )


def set_clock(x: Vector, P: Matrix, m: Measurement, locked_s: Number, repeats: Number) -> ClockSet:
    """Let the range that most others agree with define the clock; doubt those that do not agree.

    Args:
        x, P: predicted mean (8,) and covariance (8, 8), in which nothing is known about the clock.
        m: the measurement, of a partial layout.
        locked_s: time of epochs with links since a link last passed its gate, s.
        repeats: by how much to multiply all noise after ranges have been compared, because errors
            repeat those of the epochs before.
    """
    links = range(m.layout.anchors)
    has_range = [m.visible[a] * m.measured[4 * a] for a in links]
    limit = chi_square_limits(_QUANTILE)[0]
    pivot = _pivot(x, P, m, has_range, limit)
    some = sum(pivot.chosen[1:], pivot.chosen[0])  # 1 if there is a range, else 0
    Pu = [dot(row[:3], pivot.u) for row in P]
    cross = [0.0 - some * c for c in Pu[:-1]]
    own = some * (dot(pivot.u, Pu[:3]) + repeats * pivot.variance) + (1.0 - some) * P[-1][-1]
    patience = (1.0 + locked_s) * (1.0 + locked_s)
    variance = [v * repeats for v in m.variance]
    measured = list(m.measured)
    doubt = []
    log_inflation: Number = 0.0
    for a in links:
        T = pivot.T[a] * has_range[a] * some
        excess = T / (limit * patience * patience)
        squared = maximum(excess * excess, 1.0)
        noise = pivot.variance + m.variance[4 * a]
        grown = where(excess > 1.0, squared * pivot.S[a] / noise, 1.0)
        log_inflation = log_inflation + 0.5 * log(grown)  # a product of many would overflow
        variance[4 * a] = variance[4 * a] + repeats * ((squared - 1.0) * pivot.S[a])
        measured[4 * a] = measured[4 * a] * (1.0 - pivot.chosen[a])
        doubt.append(where(T > limit, T, 0.0))
    return ClockSet(
        [*x[:-1], some * pivot.y + (1.0 - some) * x[-1]],
        [*([*row[:-1], c] for row, c in zip(P[:-1], cross, strict=True)), [*cross, own]],
        m._replace(variance=variance, measured=measured),
        pivot.chosen,
        doubt,
        log_inflation,
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
    variance = m.variance[m.layout.ranges]
    T: list[Numbers] = [[0.0] * len(y) for _ in y]
    S: list[Numbers] = [[0.0] * len(y) for _ in y]
    for i in range(len(y)):
        for j in range(i):
            g = minus(u[i], u[j])
            e = y[i] - y[j]
            spread = dot(g, [dot(row[:3], g) for row in P[:3]])
            S[i][j] = S[j][i] = spread + variance[i] + variance[j]
            T[i][j] = T[j][i] = e * e / S[i][j]
    pivots = []
    for a in range(len(y)):
        chosen: Numbers = [0.0] * len(y)
        chosen[a] = has_range[a]
        score = dot(has_range, [minimum(value, limit) for value in T[a]])
        score = where(has_range[a] > 0.5, score, _UNSEEN)
        pivots.append(_Pivot(score, chosen, y[a], u[a], variance[a], T[a], S[a]))
    best = pivots[0]
    for pivot in pivots[1:]:
        best = select(pivot.score < best.score, pivot, best)
    return best
