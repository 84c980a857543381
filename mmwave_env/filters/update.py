"""The measurement update shared by EKF, UKF and CKF (paper, Sec. III-C).

The usual form, K = P H' S^-1 for all rows together, is in :mod:`~mmwave_env.filters.textbook`. The
form here computes the same result with smaller matrices. It uses the *latents* (latent variables)
of :mod:`~mmwave_env.filters.linearization`: xi, such that the state is mean + L xi, and curvatures.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from mmwave_env.filters.gating import Gate, at_degrees, chi_square_limits, gate_groups
from mmwave_env.filters.linearization import (
    Latents,
    Linearization,
    SigmaPoints,
    Tangent,
    linearize,
)
from mmwave_env.models.measurement import ROWS_OF_LINK, Measurement
from mmwave_env.numerics.linalg import cholesky, dot, forward, plus, product, symmetric
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Vector, maximum


class Posterior(NamedTuple):
    """The result of an update.

    Attributes:
        x: (7,) mean.
        P: (7, 7) covariance.
        nis: (groups,) normalized innovation squared at the prior; 0 if the group is missing.
        accepted: (groups,) 1 if the group was used, else 0.
        log_likelihood: sum of the log densities of the visible groups' innovations, as if groups
            were independent. Groups that were not accepted are included; the constant
            -(rows / 2) log(2 pi) is left out.
    """

    x: Numbers
    P: Matrix
    nis: Numbers
    accepted: Numbers
    log_likelihood: Number


Algorithm = Callable[[Vector, Matrix, Measurement, Gate], Posterior]


_Gated = tuple[Vector, Number, Number, Number]  # coefficients, innovation, noise, acceptance


class _Row(NamedTuple):
    """A scalar row that depends on all latents, conditioned on the links and the rows before it."""

    # white: C^-1 times the row's coefficients on the coupled latents; C C' is B of :func:`update`
    white: Numbers
    free: Numbers  # coefficients on the free latents, xi_3..6
    shared: Numbers  # conditional covariance with each earlier row
    cross: Numbers  # conditional covariance with each latent in xi
    innovation: Number
    gain: Number  # 1 / innovation variance; 0 if the row is not accepted


def _condition(
    gated: _Gated, before: list[_Row], C: Matrix, information: Vector, unit: Matrix
) -> _Row:
    """Condition the belief on one scalar row, given the links and the rows before it."""
    row, innovation, noise, accepted = gated
    n = len(information)
    white = forward(C, row[:n])
    free = list(row[n:])
    cross = [dot(u, white) for u in unit] + free
    s = noise + dot(white, white) + dot(free, free)
    e = innovation - dot(white, information)
    shared: Numbers = []
    for j, earlier in enumerate(before):
        c = dot(white, earlier.white) + dot(free, earlier.free)
        for i in range(j):
            c = c - before[i].gain * shared[i] * earlier.shared[i]
        shared.append(c)
        k = earlier.gain * c
        s = s - k * c
        e = e - k * earlier.innovation
        cross = [a - k * b for a, b in zip(cross, earlier.cross, strict=True)]
    return _Row(white, free, shared, cross, e, accepted / s)


def _information(latents: Latents, rows: Sequence[_Gated]) -> tuple[Matrix, Numbers]:
    """Return the information matrix and vector of the coupled latents, given the links' rows."""
    n = latents.coupled
    B: list[Numbers] = latents.precision
    b: Numbers = [0.0] * n
    for row, y, variance, accepted in rows:
        w = accepted / variance
        for i in range(n):
            weighted = w * row[i]
            b[i] = b[i] + weighted * y
            for j in range(i + 1):
                B[i][j] = B[i][j] + weighted * row[j]
    return B, b


def update(
    x: Vector, P: Matrix, measurement: Measurement, gate: Gate, linearization: Linearization
) -> Posterior:
    """Gate every group at the prior N(x, P), then condition on the groups that passed.

    The links depend only on the *coupled latents*: the latents of the first three columns of the
    factor L of P (four with a clock), and the curvature latents. So prior and links add up to one
    small information matrix B: given the links, the covariance of the coupled latents is B^-1. The
    other latents are *free*. Rows of other groups are added one by one. The new covariance is

        L_c D L_c' + sum_j L_j L_j' - sum_i gain_i c_i c_i'

    L_c are the first columns of L, D is the block of B^-1 for their latents, L_j are the other
    columns, c_i is the covariance of the state with row i, and gain_i is the gain in :class:`_Row`.

    The prior is x (7,) and P (7, 7), positive definite except for the zeros of components that are
    known exactly. The linearization is the tangent (EKF) or sigma points (UKF, CKF).
    """
    L, latents, groups, V = prior = linearize(x, P, measurement, linearization)
    gates = gate_groups(prior, measurement, gate)
    gated: list[_Gated] = []
    for group, rows, noise, accepted in zip(groups, V, gates.noise, gates.accepted, strict=True):
        for row, y, variance in zip(rows, group.innovation, noise, strict=True):
            gated.append((row, y - latents.shift(row), variance, accepted))
    of_links = ROWS_OF_LINK * measurement.layout.anchors
    B, b = _information(latents, gated[:of_links])
    C = cholesky(B)
    information = forward(C, b)
    linear = latents.linear
    unit = [forward(C, [float(i == c) for i in range(len(b))]) for c in range(linear)]
    scalars: list[_Row] = []
    for each in gated[of_links:]:
        scalars.append(_condition(each, scalars, C, information, unit))
    mean = [dot(u, information) for u in unit]
    covariance = symmetric(linear, lambda i, j: dot(unit[i], unit[j]))
    new_x, new_P = _recompose(x, L, mean, covariance, scalars)
    return Posterior(new_x, new_P, gates.nis, gates.accepted, gates.log_likelihood)


def _recompose(
    x: Vector, L: Matrix, mean: Vector, covariance: Matrix, rows: list[_Row]
) -> tuple[Numbers, Matrix]:
    """Return the state's mean and covariance, given the moments of xi_0..2 and the scalar rows."""
    k = len(mean)
    n = len(x)
    spread = product(L, covariance)
    moves = [[dot(line, row.cross) for line in L] for row in rows]
    new_x = plus(x, [dot(line, mean) for line in L])
    for row, step in zip(rows, moves, strict=True):
        gain = row.gain * row.innovation
        new_x = [value + gain * moved for value, moved in zip(new_x, step, strict=True)]

    def entry(i: int, j: int) -> Number:
        value = dot(spread[i], L[j][:k]) + dot(L[i][k:], L[j][k:])
        for row, step in zip(rows, moves, strict=True):
            value = value - row.gain * (step[i] * step[j])
        return value

    return new_x, symmetric(n, entry)


def ekf(x: Vector, P: Matrix, measurement: Measurement, gate: Gate) -> Posterior:
    """Run the extended Kalman filter update (paper, Sec. III-C.1)."""
    return update(x, P, measurement, gate, Tangent())


def ukf(x: Vector, P: Matrix, measurement: Measurement, gate: Gate) -> Posterior:
    """Run the unscented Kalman filter update, alpha 1, beta 2, kappa 0 (paper, Sec. III-C.2)."""
    return update(x, P, measurement, gate, SigmaPoints(1.0, 2.0, 0.0))


def ckf(x: Vector, P: Matrix, measurement: Measurement, gate: Gate) -> Posterior:
    """Run the cubature Kalman filter update (Arasaratnam and Haykin 2009)."""
    return update(x, P, measurement, gate, SigmaPoints(1.0, 0.0, 0.0))


CAP_QUANTILE = 0.999  # to compare modes, NIS is limited to this chi-square quantile


class ModeResult(NamedTuple):
    """The result of a mode in an epoch."""

    x: Numbers  # (7,) posterior mean
    P: Numbers  # (28,) packed posterior covariance (lower triangle); (36,) with a clock
    # x_predicted, P_predicted: mean and packed covariance before the update, for smoothing
    x_predicted: Numbers
    P_predicted: Numbers
    # nis, accepted: (groups,) as in :class:`Posterior`
    nis: Numbers
    accepted: Numbers
    passed: Number  # number of links whose NIS passed the gate; recovery also accepts other links
    log_likelihood: Number  # log-likelihood of the visible groups


def limited_likelihood(candidate: ModeResult, limits: Vector) -> Number:
    """Return a mode's log-likelihood after limiting each group's NIS; ``limits`` is (groups,).

    The tail of a Gaussian falls so fast that, without limits, a single outlier (a link off the line
    of sight) would decide: the mode whose prediction is nearest to the outlier would seem right.
    """
    excess = [maximum(nis - limit, 0.0) for nis, limit in zip(candidate.nis, limits, strict=True)]
    return candidate.log_likelihood + 0.5 * sum(excess, 0.0)


def capped_log_likelihood(candidate: ModeResult, degrees: Sequence[Number]) -> Number:
    """Return the log-likelihood by which modes are compared; :data:`CAP_QUANTILE` limits the NIS.

    ``degrees`` (groups,) are the groups' degrees of freedom, from
    :meth:`~mmwave_env.models.layout.Layout.degrees`.
    """
    limits = chi_square_limits(CAP_QUANTILE)
    return limited_likelihood(candidate, [at_degrees(limits, rows) for rows in degrees])
