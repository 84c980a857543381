"""Rewards: functions of a belief (mean and covariance) and the truth.

A reward is called as ``reward(belief, truth)`` with a
:class:`~mmwave_env.filters.belief.Belief` and the true position and velocity (6,). It returns the
reward, or a dict of named terms, whose sum is the reward. Pass your own reward to
``MmWaveLoc-v0`` as ``reward=``. It must follow the rules of :mod:`mmwave_env.numerics.numbers`,
because it is compiled for SIMD lanes. :class:`PairedReward` subtracts the reward of an IMM.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.custom import complaint, name_of, try_out, wrong_parts
from mmwave_env.io.lookup import choose, quoted
from mmwave_env.numerics.numbers import Number, Pair, Vector, log, maximum, minimum
from mmwave_env.numerics.tape import taped

Terms = dict[str, Number]
Reward = Callable[[Belief, Vector], Terms | Number]

_SMALLEST_NEES = 1e-12
TRIED_ERRORS_M = np.array([0.1, 1.0, 10.0, 100.0])  # for which a reward must be finite


@dataclass(frozen=True)
class TrackingReward:
    """The default reward, which penalizes the error and a NEES that is too large or too small.

    It is -(error_weight min(error, error_limit_m) + nees_weight min(|ln(NEES / d)|, nees_limit)),
    where d is the number of estimated position axes. So it does not pay to inflate or shrink P.
    """

    error_weight: float = 1.0
    error_limit_m: float = 10.0
    nees_weight: float = 0.2
    nees_limit: float = 3.0

    @property
    def worst(self) -> float:
        """Return the lowest possible reward."""
        return -(self.error_weight * self.error_limit_m + self.nees_weight * self.nees_limit)

    def costs(self, distance_m: Number, nees: Number, axes: int) -> Pair:
        """Compute the costs (...,) of error and NEES in each epoch; the reward is minus their sum.

        Args:
            distance_m: length of the position error, a number or an array (...,).
            nees: NEES of the position axes, of the same kind.
            axes: number of position axes.
        """
        error = minimum(distance_m, self.error_limit_m)
        inconsistency = abs(log(maximum(nees, _SMALLEST_NEES) * (1.0 / axes)))
        return self.error_weight * error, self.nees_weight * minimum(inconsistency, self.nees_limit)

    def __call__(self, belief: Belief, truth: Vector) -> Terms:
        """Return the terms of one epoch."""
        error, nees = self.costs(belief.distance(truth), belief.nees(truth), len(belief.axes))
        return {"error": -error, "nees": -nees}


@dataclass(frozen=True)
class LogScore:
    """The log density of the true position (a proper score, in nats), but at least ``worst``."""

    worst: float = -30.0

    def __call__(self, belief: Belief, truth: Vector) -> Number:
        """Return the reward of one epoch."""
        return maximum(belief.log_density(truth), self.worst)


@dataclass(frozen=True)
class PairedReward:
    """The agent's reward minus the reward of an IMM, in the same epoch of the same episode.

    If modes share a belief, the IMM mixes the two default modes of the radio. If each mode has its
    own belief, the IMM mixes the modes of the agent's bank. Actions do not change the IMM's reward,
    so the best policy stays the same. The difficulty of an episode cancels out in the difference,
    so its variance is smaller than the reward's. If an episode ends early because of divergence,
    the IMM's rewards in the remaining epochs are also subtracted.

    Attributes:
        reward: reward of agent and IMM, a function of (belief, truth).
    """

    reward: Reward = TrackingReward()


REWARDS: dict[str, Reward | PairedReward] = {
    "tracking": TrackingReward(),
    "log-score": LogScore(),
    "paired": PairedReward(),
}


def terms_of(paid: Terms | Number) -> Terms:
    """Return what a reward returned as terms by name; a number becomes a term named "reward"."""
    return paid if isinstance(paid, dict) else {"reward": paid}


def total(terms: Terms) -> Number:
    """Return the reward, which is the sum of its terms."""
    return sum(terms.values(), 0.0)


@lru_cache(maxsize=64)
def term_names(reward: Reward) -> tuple[str, ...]:
    """Return the names of a reward's terms."""
    return tuple(terms_of(reward(*_trial())))


def reward_from(reward: str | Reward | PairedReward) -> Reward | PairedReward:
    """Return the reward that a user passed: a name, a function or a paired reward.

    Raises:
        ValueError: the name is unknown, or the function is not hashable, cannot run on SIMD lanes
            or does not return numbers.
    """
    function = reward.reward if isinstance(reward, PairedReward) else reward
    if isinstance(reward, str) or not callable(function):
        return choose(REWARDS, cast(str, reward), "reward")
    try:
        hash(function)
    except TypeError as error:
        raise ValueError(
            f"reward: found {function!r}, expected a hashable function or object"
        ) from error
    _check(function)
    return reward


def reward_name(reward: Reward) -> str:
    """Return the name of a reward in :data:`REWARDS`, else the name of its function or class.

    For example, the name of a :class:`TrackingReward` with other parameters is "TrackingReward".
    """
    for name, known in REWARDS.items():
        if reward == known:
            return name
    return name_of(reward)


def _trial() -> tuple[Belief, Vector]:
    """Return a belief and a truth to try a reward with; an ``if`` on their numbers is an error."""
    numbers: list[Any] = [[0.0] * 7, [[0.0] * 7] * 7, [0.0] * 6]
    x, P, truth = taped(numbers, [])
    return Belief(x, P), truth


def _check(reward: Reward) -> None:
    """Refuse a reward that fails in a trial run or does not return finite numbers."""
    subject = f"reward {name_of(reward)}"

    def refused(problem: str) -> ValueError:
        return ValueError(complaint(subject, reward, problem))

    terms = terms_of(try_out(reward, _trial(), subject, ValueError))
    if not terms or not all(isinstance(name, str) and name != "cost" for name in terms):
        expected = 'one or more strings other than "cost", which names the modes\' costs'
        raise refused(f"returned terms named {list(terms)}, expected {expected}")
    for name, value in terms.items():
        if problem := next(wrong_parts(name, value, 0.0), ""):
            raise refused(f"returned {problem}")
    x = [TRIED_ERRORS_M, 0.0, 1.5, 1.0, 0.5, 0.0, 0.0]
    example = Belief(x, np.eye(7).tolist()), [0.0, *x[1:6]]
    with np.errstate(all="ignore"):
        terms = terms_of(try_out(reward, example, subject, ValueError))
    for name, value in terms.items():
        if not np.all(abs(value) <= sys.float_info.max):
            raise refused(
                f"returned {name}: {quoted(value)} for errors of {TRIED_ERRORS_M} m, expected "
                "finite numbers"
            )
