"""Gates, which decide which groups of a measurement to use, and with how much noise.

The groups are the link to each anchor, the Doppler shift and the odometry. A gate compares a
group's normalized innovation squared (NIS) with a chi-square quantile (paper, Sec. III-D).
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

from mmwave_env.filters.linearization import Latents, Prior
from mmwave_env.models.measurement import Group, Measurement
from mmwave_env.numerics.linalg import dot, mahalanobis, minus, symmetric, times
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Pair, log, maximum, where

_GROUPS_PER_LOG = 8  # the product of the determinants of this many groups fits into a double
ROBUST_ONSET = 1.5  # a link is doubtful if its NIS, divided by its number of rows, exceeds this


class Gate(NamedTuple):
    """The rule for measurements that look wrong.

    Attributes:
        quantile: probability, such as 0.99: a group is accepted if its NIS is at most the
            chi-square quantile of this probability; None to accept all groups.
        force: 1 to accept all links, because all failed their gates in too many epochs; else 0.
        robust: whether to inflate the noise of a doubtful link instead of rejecting it.
    """

    quantile: float | None
    force: Number = 0.0
    robust: bool = False


def innovation_statistics(group: Group, V: Matrix, latents: Latents) -> Pair:
    """Return a group's NIS y' S^-1 y and det S, where y is its innovation at the prior.

    The covariance S of y is H P H' + R in :mod:`~mmwave_env.filters.textbook`; here it is
    V cov(eta) V' + R, with the latent variables eta of :mod:`~mmwave_env.filters.linearization`.
    """
    shift = [latents.shift(row) for row in V]
    variance = latents.variance

    def entry(i: int, j: int) -> Number:
        value = dot(variance, times(V[i], V[j]))
        value = value + latents.bend * (shift[i] * shift[j])
        return value + group.variance[i] if i == j else value

    nis, determinant = mahalanobis(symmetric(len(V), entry), minus(group.innovation, shift))
    return nis + group.spare_nis, determinant * group.spare_determinant


@cache
def chi_square_limits(quantile: float) -> list[float]:
    """Return the chi-square quantiles for 1 to 4 degrees of freedom; a group has at most 4."""
    from scipy.special import chdtri  # slow to import, and not needed to describe a mode

    return [float(chdtri(rows, 1.0 - quantile)) for rows in range(1, 5)]


def at_degrees(limits: Sequence[Number], rows: Number) -> Number:
    """Return the limit for ``rows`` degrees of freedom; ``limits[k]`` is the limit for k + 1."""
    if isinstance(rows, int):
        return limits[rows - 1]
    limit = limits[0]
    for k, larger in enumerate(limits[1:], start=1):
        limit = where(rows > k + 0.5, larger, limit)
    return limit


def passes(nis: Number, rows: Number, quantile: float | None) -> Number:
    """Return 1 if a group with this NIS and number of rows passes its gate, else 0."""
    if quantile is None:
        return 1.0
    return where(nis <= at_degrees(chi_square_limits(quantile), rows), 1.0, 0.0)


class GateResult(NamedTuple):
    """The decision of the gate about each group, from innovations at the prior."""

    # nis, accepted, log_likelihood: same as in :class:`~mmwave_env.filters.update.Posterior`
    nis: Numbers
    accepted: Numbers
    noise: Matrix  # per group, (k,) noise variances, inflated for doubtful links
    log_likelihood: Number


def gate_groups(prior: Prior, measurement: Measurement, gate: Gate) -> GateResult:
    """Apply the gate to the innovation of every group at the prior."""
    groups = prior.groups
    V = prior.V
    latents = prior.latents
    layout = measurement.layout
    degrees = layout.degrees(measurement.measured)
    nis = []
    accepted = []
    noise = []
    density: Number = 1.0
    likelihood: Number = 0.0
    for g, (group, visible) in enumerate(zip(groups, measurement.visible, strict=True)):
        rows = degrees[g]
        is_link = g < layout.anchors
        value, determinant = innovation_statistics(group, V[g], latents)
        nis.append(visible * value)
        density = density * where(visible > 0.5, determinant, 1.0)
        likelihood = likelihood - 0.5 * nis[-1]
        if g % _GROUPS_PER_LOG == _GROUPS_PER_LOG - 1 or g == len(groups) - 1:
            likelihood = likelihood - 0.5 * log(density)
            density = 1.0
        if gate.robust and is_link:  # inflate the noise if the NIS is too large
            ratio = value * (1.0 / (ROBUST_ONSET * maximum(rows, 1)))
            doubt = where(ratio > 1.0, ratio * ratio, 1.0)
            accepted.append(visible)
            noise.append([v * doubt for v in group.variance])
        else:
            passed = passes(value, rows, gate.quantile)
            accepted.append(visible * (maximum(passed, gate.force) if is_link else passed))
            noise.append(list(group.variance))
    return GateResult(nis, accepted, noise, likelihood)
