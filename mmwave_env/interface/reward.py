"""Rewards: functions of a belief and the truth, written on numbers.

A reward is called as ``reward(belief, truth)`` with a
:class:`~mmwave_env.filters.belief.Belief` and the true (6,) position and velocity, and returns
its terms by name, whose sum is paid, or one number. Pass your own reward to ``MmWaveLoc-v0`` as
``reward=``; it follows the rules of :mod:`mmwave_env.numerics.numbers`, so it runs on SIMD lanes
like all other code. Any reward can be paired (:class:`PairedReward`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, reduce
from operator import add
from typing import cast

import numpy as np

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.custom import begin_of, line_of
from mmwave_env.io.lookup import choose
from mmwave_env.numerics.numbers import Array, Number, Vector, log, maximum, minimum
from mmwave_env.numerics.tracer import FloatTracer, NoValueError, Tracer, TracerCondition

Terms = dict[str, Number]
Reward = Callable[[Belief, Vector], Terms | Number]

_SMALLEST_NEES = 1e-12


@dataclass(frozen=True)
class TrackingReward:
    """-(error_weight min(error, error_limit_m) + nees_weight min(|ln(NEES / d)|, nees_limit)).

    Penalizes distance from the truth and inconsistency either way; NEES is taken per epoch,
    so inflating the covariance does not pay. d is the number of estimated position axes.
    """

    error_weight: float = 1.0
    error_limit_m: float = 10.0
    nees_weight: float = 0.2
    nees_limit: float = 3.0

    @property
    def worst(self) -> float:
        """Return the lowest possible reward."""
        return -(self.error_weight * self.error_limit_m + self.nees_weight * self.nees_limit)

    def costs(self, distance_m: Array, nees: Array, axes: int = 3) -> tuple[Array, Array]:
        """Compute the cost of error and NEES in epochs (...,); the reward is minus their sum.

        Args:
            distance_m: (...,) length of the position error.
            nees: (...,) NEES of the position axes.
            axes: number of position axes.
        """
        error = np.minimum(distance_m, self.error_limit_m)
        inconsistency = np.abs(np.log(np.maximum(nees, _SMALLEST_NEES) / axes))
        limited = np.minimum(inconsistency, self.nees_limit)
        return self.error_weight * error, self.nees_weight * limited

    def __call__(self, belief: Belief, truth: Vector) -> Terms:
        """Return the terms of one epoch."""
        error = minimum(belief.distance(truth), self.error_limit_m)
        ratio = maximum(belief.nees(truth), _SMALLEST_NEES) * (1.0 / len(belief.axes))
        inconsistency = minimum(abs(log(ratio)), self.nees_limit)
        return {"error": -(self.error_weight * error), "nees": -(self.nees_weight * inconsistency)}


@dataclass(frozen=True)
class LogScore:
    """Log density of the true position, a proper score in nats, no lower than ``worst``."""

    worst: float = -30.0

    def __call__(self, belief: Belief, truth: Vector) -> Number:
        """Return the reward of one epoch."""
        return maximum(belief.log_density(truth), self.worst)


@dataclass(frozen=True)
class PairedReward:
    """A reward minus what an IMM earns by it, in the same epoch of the same episode.

    The IMM mixes the two default modes of the radio, whatever the agent chooses from. An action
    changes nothing of what it earns, so the best policy stays the same; that an episode is hard
    cancels out, so the variance falls. Where an episode ends early because of divergence, what
    the IMM earns in the epochs left is subtracted, too.

    Attributes:
        reward: function of (belief, truth).
    """

    reward: Reward = TrackingReward()


REWARDS: dict[str, Reward | PairedReward] = {
    "tracking": TrackingReward(),
    "log-score": LogScore(),
    "paired": PairedReward(),
}


def terms_of(reward: Reward, belief: Belief, truth: Vector) -> Terms:
    """Return the terms of a reward by name; a reward of one number has the term "reward"."""
    paid = reward(belief, truth)
    return paid if isinstance(paid, dict) else {"reward": paid}


def total(terms: Terms) -> Number:
    """Return the sum of terms, which is the reward."""
    return cast(Number, reduce(add, terms.values()))


@lru_cache(maxsize=64)
def term_names(reward: Reward) -> tuple[str, ...]:
    """Return the names of a reward's terms."""
    return tuple(terms_of(reward, *_trial()))


def reward_from(reward: str | Reward | PairedReward) -> Reward | PairedReward:
    """Return the reward for ``reward=``: a name, a function of (belief, truth), or paired.

    Raises:
        ValueError: the name is unknown, or the function is not hashable, cannot run on lanes or
            returns no number.
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
    """Return the name of a reward in :data:`REWARDS`, or else the name of the function or class.

    A known reward with other weights has the name of its class.
    """
    for name, known in REWARDS.items():
        if reward == known:
            return name
    return str(getattr(reward, "__name__", type(reward).__name__))


def _trial() -> tuple[Belief, Vector]:
    """Return a belief and a truth of numbers that hide their value, as the compiler's do."""
    P = [[FloatTracer(4.0 if i == j else 0.5) for j in range(7)] for i in range(7)]
    belief = Belief([FloatTracer(float(i)) for i in range(7)], P)
    return belief, [FloatTracer(0.5 * i) for i in range(6)]


def _check(reward: Reward) -> None:
    """Try a function on numbers that hide their value."""
    try:
        terms = terms_of(reward, *_trial())
    except NoValueError as refusal:
        raise _refused(reward, "cannot run on lanes", refusal, str(refusal)) from None
    except Exception as error:
        advice = f"{type(error).__name__}: {error}"
        raise _refused(reward, "failed on trial", error, advice) from error
    if not terms or not all(isinstance(name, str) for name in terms):
        raise _refused(reward, f"returned the terms {list(terms)}, expected one name or more")
    for value in terms.values():
        if isinstance(value, bool | TracerCondition):
            raise _refused(reward, "returned a condition, expected where(condition, 1.0, 0.0)")
        if not isinstance(value, float | int | Tracer):
            kind = "None" if value is None else type(value).__name__
            raise _refused(reward, f"returned {kind}, expected a number, or numbers by name")


def _refused(
    reward: Reward, problem: str, error: BaseException | None = None, *advice: str
) -> ValueError:
    name = getattr(reward, "__name__", type(reward).__name__)
    line = (error and line_of(error, reward)) or begin_of(reward)
    # Gymnasium appends the arguments of the environment to a message: start a new line for them.
    return ValueError("\n".join([f"reward {name} {problem}", str(line), *advice, ""]))
