"""The step of many environments, from actions to infos, in one call of compiled code.

With few environments, the Python code around that call (:mod:`mmwave_env.engines.environment`)
takes a third of a step's time or more. So the Python code neither assembles nor splits arrays.

A step also keeps the sums from which metrics are computed when an episode ends (:class:`Tally`).
"""

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.advance import advance
from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.metrics import BURN_IN, RISK, Sums, nees_interval, running_summary
from mmwave_env.numerics.numbers import Array, Index, Mask

# columns of the sums: the fields of :class:`~mmwave_env.metrics.Sums` from ``distance`` on
LENGTH, SQUARED, CHANGE, NEES, INSIDE, LARGEST = range(6)
NONFINITE = 6  # column: number of epochs, burn-in included, whose error or NEES is not finite
SUMS = 7

# The horizontal protection level is the error that is exceeded with probability RISK. Its square,
# divided by the variance along the longer axis of the error ellipse, lies between these numbers:
# NARROWEST if the shorter axis is 0, WIDEST if both axes are equal.
NARROWEST = NormalDist().inv_cdf(0.5 * RISK) ** 2
WIDEST = -2.0 * math.log(RISK)
# for exceeds(): number of angles per quadrant, smallest variance (m^2)
ANGLES = 16
LEAST = 1e-12


class Counts(NamedTuple):
    """The records of n environments."""

    sums: Array  # (n, 7)
    errors: Array  # (n, T, 3) ring buffer of the latest position errors, m
    second: Index  # (n,) number of epochs in a second, from 1 to the length of the episode
    interval: Array  # (2,) interval that contains 95 % of a consistent filter's NEES


class Tally:
    """Records of episodes: sums over the epochs that count in the metrics.

    Args:
        n: number of environments.
        axes: number of position axes that NEES covers.

    Attributes:
        counts: the records; the buffer of errors covers a second, but at most the whole episode.
    """

    def __init__(self, n: int, axes: int) -> None:
        self.counts = Counts(
            sums=np.zeros((n, SUMS)),
            errors=np.zeros((n, 1, 3)),
            second=np.ones(n, np.int64),
            interval=np.array(nees_interval(axes)),
        )

    def begin(self, places: Index, step_s: Array, epochs: Index) -> None:
        """Start k episodes, given their seconds per epoch (k,) and their numbers of epochs (k,)."""
        second = self.counts.second
        second[places] = np.clip(np.round(1.0 / step_s), 1, epochs)
        errors = self.counts.errors
        missing = max(0, second.max() - errors.shape[1])
        errors = np.pad(errors, ((0, 0), (0, missing), (0, 0)))
        self.counts = self.counts._replace(errors=errors)

    def nonfinite(self, places: Index) -> Index:
        """Return, for environments (k,), how many epochs (k,) have a non-finite error or NEES."""
        return self.counts.sums[places, NONFINITE].astype(np.int64)  # type: ignore[no-any-return]

    def metrics(self, places: Index, epochs: Index) -> dict[str, Array]:
        """Return the running metrics of some environments (k,), by name.

        Args:
            places: (k,) environments.
            epochs: (k,) number of epochs that each environment ran.
        """
        counted = np.maximum(epochs - BURN_IN, 1)
        changes = np.maximum(counted - self.counts.second[places], 0)
        return running_summary(Sums(counted, changes, *self.counts.sums[places, :NONFINITE].T))


@register_jitable
def count(counts, e, k, x, y, z, nees):  # type: ignore[no-untyped-def]
    """Count epoch ``k`` (counted from 0) of an episode, with its position error (m) and NEES.

    Each of the first BURN_IN + 1 epochs starts the sums anew, so the burn-in (the first BURN_IN
    epochs) does not count. An episode that ends in the burn-in is scored by its last epoch.

    Args:
        counts: a :class:`Counts`, changed in place.
        e: index of the environment.
    """
    sums = counts.sums[e]
    errors = counts.errors[e]
    second = counts.second[e]
    if k <= BURN_IN:
        for i in range(NONFINITE):
            sums[i] = 0.0
    if k == 0:
        sums[NONFINITE] = 0.0
    squared = x * x + y * y + z * z
    if not (math.isfinite(squared) and math.isfinite(nees)):
        sums[NONFINITE] += 1.0
    sums[LENGTH] += math.sqrt(squared)
    sums[SQUARED] += squared
    sums[NEES] += nees
    if counts.interval[0] <= nees <= counts.interval[1]:
        sums[INSIDE] += 1.0
    if squared > sums[LARGEST] or math.isnan(squared):  # once NaN, it stays NaN
        sums[LARGEST] = squared
    now = errors[k % second if second > 1 else 0]  # no slow division if epochs last 1 s
    if k >= BURN_IN + second:
        u = x - now[0]
        v = y - now[1]
        w = z - now[2]
        sums[CHANGE] += math.sqrt(u * u + v * v + w * w)
    now[0] = x
    now[1] = y
    now[2] = z


@register_jitable
def exceeds(x, y, xx, xy, yy):  # type: ignore[no-untyped-def]
    """Return 1.0 if a horizontal error exceeds its protection level, or is NaN; else 0.0.

    The error (x, y), m, with covariance (xx, xy, yy), m^2, exceeds the level if larger errors have
    a probability below RISK. Most errors are so small or so large that this probability need not be
    integrated; :mod:`mmwave_env.localization.position_errors` explains the integral.
    """
    squared = x * x + y * y
    middle = 0.5 * (xx + yy)
    slope = 0.5 * (xx - yy)
    half = math.sqrt(slope * slope + xy * xy)
    if squared <= NARROWEST * (middle + half):
        return 0.0
    if squared > WIDEST * (middle + half):
        return 1.0
    larger = 0.0
    for i in range(ANGLES):
        turn = (i + 0.5) * (math.pi / ANGLES)  # twice the angle to the longer axis
        larger += math.exp(-0.5 * squared / max(middle + half * math.cos(turn), LEAST))
    return 0.0 if larger >= RISK * ANGLES else 1.0


class StepResult(NamedTuple):
    """The arrays that a step of n environments fills."""

    observations: NDArray[np.float32]  # (n, features)
    rewards: Array  # (n,) results of the reward function
    terminated: Mask  # (n,) False; the caller sets it where a track diverges
    truncated: Mask  # (n,) whether the episode has no epoch left
    # accepted, rejected: (n, groups) the gates' verdicts
    accepted: Mask
    rejected: Mask
    cost: Array  # (n,) 1.0 where an error exceeds its protection level


# The first output columns: reward, NEES, three columns of position error, and three of the
# covariance of the horizontal position; then the gates' verdicts.
AT_REWARD = 0
AT_NEES = 1
AT_ERROR = 2
AT_COVARIANCE = 5
AT_VERDICTS = 8


@compiled
def step_blocks(  # type: ignore[no-untyped-def]
    begin, end, run, blank, state, io, actions, result, counts
):
    """Step the environments of blocks ``begin`` to ``end`` - 1; return how many episodes ended.

    If ``run`` is 0, the program has run already, and only the results are filled.
    """
    first = begin * WIDTH
    last = min(end * WIDTH, len(actions))
    inputs = io.inputs
    outputs = io.outputs
    epoch = state.epoch
    length = state.length
    if run != 0:
        for e in range(first, last):
            inputs[e, 0, 0] = actions[e]
        advance(begin, end, run, blank, state, io)
    _, rewards, _, truncated, accepted, rejected, costs = result
    ended = 0
    for e in range(first, last):
        rewards[e] = outputs[e, 0, AT_REWARD]
        x = outputs[e, 0, AT_ERROR]
        y = outputs[e, 0, AT_ERROR + 1]
        z = outputs[e, 0, AT_ERROR + 2]
        k = epoch[e] - 2  # the epoch that the action completed
        if k >= 0:
            count(counts, e, k, x, y, z, outputs[e, 0, AT_NEES])
        xx = outputs[e, 0, AT_COVARIANCE]
        xy = outputs[e, 0, AT_COVARIANCE + 1]
        yy = outputs[e, 0, AT_COVARIANCE + 2]
        costs[e] = exceeds(x, y, xx, xy, yy)
        for g in range(accepted.shape[1]):
            accepted[e, g] = outputs[e, 0, AT_VERDICTS + g] > 0.5
            rejected[e, g] = outputs[e, 0, AT_VERDICTS + accepted.shape[1] + g] > 0.5
        truncated[e] = epoch[e] > length[e]
        ended += truncated[e]
    return ended
