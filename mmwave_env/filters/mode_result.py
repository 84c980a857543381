"""What a mode makes of an epoch, and how well it explains what was measured."""

from typing import NamedTuple

from mmwave_env.models.measurement import Layout
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Number, Vector, maximum

CAP_QUANTILE = 0.999  # chi-square quantile up to which NIS counts where modes are compared


class ModeResult(NamedTuple):
    """What a mode makes of an epoch."""

    x: list[Number]  # (7,) posterior mean
    P: list[Number]  # (28,) packed posterior covariance
    # x_predicted, P_predicted: (7,), (28,) belief before the update, for smoothing
    x_predicted: list[Number]
    P_predicted: list[Number]
    # nis, accepted: (groups,) as in :class:`~mmwave_env.filters.update.Posterior`
    nis: list[Number]
    accepted: list[Number]
    passed: Number  # how many links passed their gates, forced ones not counted
    log_likelihood: Number  # of the visible groups


def limited_likelihood(candidate: ModeResult, limits: Vector) -> Number:
    """Log-likelihood in which the NIS of a group (groups,) counts up to its limit.

    The tail of a Gaussian falls so fast that a single link off the line of sight would decide
    which mode is right, for the one that believes the outlier.
    """
    excess = [maximum(nis - limit, 0.0) for nis, limit in zip(candidate.nis, limits, strict=True)]
    return candidate.log_likelihood + 0.5 * dot(excess, [1.0] * len(excess))


def capped_log_likelihood(candidate: ModeResult, layout: Layout) -> Number:
    """The log-likelihood that modes are compared by, limited at :data:`CAP_QUANTILE`."""
    from scipy.special import chdtri

    rows = [group.stop - group.start for group in layout.groups]
    return limited_likelihood(candidate, [float(chdtri(k, 1.0 - CAP_QUANTILE)) for k in rows])
