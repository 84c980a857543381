"""Metrics of a track: position errors and consistency (paper, Sec. IV; design: fixed protocol).

Errors are unaligned because the frame is known, so ATE, RMSE and RPE equal what evo computes
from the translation part without alignment. NEES is that of the position, which
:meth:`mmwave_env.filters.belief.Belief.nees` computes; with 3 axes its expectation is 3, and 95 %
of the epochs lie in the two-sided chi-square interval [0.22, 9.35]. (The paper gates a 3-D NEES at
5.99, the one-sided 95 % quantile for 2 axes; for 3 it is 7.81.)
"""

import numpy as np

from mmwave_env.numerics.numbers import Array

BURN_IN = 10  # epochs dropped from averages, because the prior still has an effect
DIVERGENCE_M = 50.0  # an episode in which the error exceeds this has diverged
METRICS = {
    "reward": "mean reward per epoch",
    "ate_m": "mean position error, m",
    "rmse_m": "root mean square position error, m",
    "rpe_m": "mean change of the position error over 1 s (at least one epoch), m",
    "nees": "mean NEES of the position",
    "in_bounds": "share of epochs with NEES in its two-sided 95 % interval",
    "divergence_rate": f"share of episodes with an error above {DIVERGENCE_M:g} m",
}
TERMS = {  # terms of the tracking reward, which is minus their sum
    "error_term": "what position errors cost in the tracking reward, per epoch",
    "nees_term": "what the NEES costs in the tracking reward, per epoch",
}


def _squared(error: Array) -> Array:
    """Compute the squared length (..., T) of errors (..., T, 3), m^2."""
    x, y, z = (error[..., axis] for axis in range(3))
    return x * x + y * y + z * z


def ate(error: Array) -> Array:
    """Compute the absolute trajectory error (...,) of errors (..., T, 3): mean length, m."""
    return np.sqrt(_squared(error)).mean(axis=-1)  # type: ignore[no-any-return]


def rmse(error: Array) -> Array:
    """Compute the root mean square (...,) of errors (..., T, 3), m."""
    return np.sqrt(_squared(error).mean(axis=-1))  # type: ignore[no-any-return]


def rpe(error: Array, delta: int = 1) -> Array:
    """Compute the relative pose error (...,): mean |e_k - e_(k - delta)| of (..., T, 3), m.

    The error of tracks no longer than ``delta`` epochs is zero.
    """
    change = error[..., delta:, :] - error[..., :-delta, :]
    if change.shape[-2] == 0:
        return np.zeros(error.shape[:-2])
    return ate(change)


def nees_interval(axes: int = 3, share: float = 0.95) -> tuple[float, float]:
    """Return the two-sided interval of a consistent filter's NEES in ``share`` of epochs."""
    from scipy.special import chdtri

    tail = (1.0 - share) / 2.0
    return float(chdtri(axes, 1.0 - tail)), float(chdtri(axes, tail))


def scored(epochs: int) -> slice:
    """Return the slice of epochs that averages use: all after the burn-in, at least one."""
    return slice(min(BURN_IN, epochs - 1), None)


def summary(
    reward: Array, error: Array, nees: Array, epochs_per_s: float = 1.0, axes: int = 3
) -> dict[str, Array]:
    """Compute all :data:`METRICS` per episode; rewards are (..., T), see :func:`accuracy`."""
    mean = reward[..., scored(reward.shape[-1])].mean(axis=-1)
    return {"reward": mean, **accuracy(error, nees, epochs_per_s, axes)}


def accuracy(
    error: Array, nees: Array, epochs_per_s: float = 1.0, axes: int = 3
) -> dict[str, Array]:
    """Compute every metric but the reward, per episode and without the burn-in.

    Args:
        error: (..., T, 3) estimated minus true position, m.
        nees: (..., T) NEES of the position.
        epochs_per_s: number of epochs in a second, the interval of RPE.
        axes: position axes that NEES covers.
    """
    counted = scored(nees.shape[-1])
    error, nees = error[..., counted, :], nees[..., counted]
    low, high = nees_interval(axes)
    return {
        "ate_m": ate(error),
        "rmse_m": rmse(error),
        "rpe_m": rpe(error, max(1, round(epochs_per_s))),
        "nees": nees.mean(axis=-1),
        "in_bounds": ((nees >= low) & (nees <= high)).mean(axis=-1),
        "divergence_rate": (~(_squared(error).max(axis=-1) <= DIVERGENCE_M**2)).astype(float),
    }
