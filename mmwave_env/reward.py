"""Rewards: functions of a belief and the truth, written on numbers.

A reward is called as ``reward(belief, truth)`` with a
:class:`~mmwave_env.filters.belief.Belief` and the true (6,) position and velocity, and
returns one number. Pass your own to ``MmWaveLoc-v0`` as ``reward=``; it follows the rules
of :mod:`mmwave_env.numerics.numbers`, so it runs on SIMD lanes like everything else. Any of them
can be paired (:class:`PairedReward`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from mmwave_env.filters.belief import Belief
from mmwave_env.lookup import choose
from mmwave_env.numerics.numbers import Number, Vector, log, maximum, minimum

Reward = Callable[[Belief, Vector], Number]

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
        """The lowest reward there is."""
        return -(self.error_weight * self.error_limit_m + self.nees_weight * self.nees_limit)

    def __call__(self, belief: Belief, truth: Vector) -> Number:
        """Reward of one epoch."""
        error = minimum(belief.distance(truth), self.error_limit_m)
        ratio = maximum(belief.nees(truth), _SMALLEST_NEES) * (1.0 / len(belief.axes))
        inconsistency = minimum(abs(log(ratio)), self.nees_limit)
        return -(self.error_weight * error + self.nees_weight * inconsistency)


@dataclass(frozen=True)
class LogScore:
    """Log density of the true position, a proper score in nats, no lower than ``worst``."""

    worst: float = -30.0

    def __call__(self, belief: Belief, truth: Vector) -> Number:
        """Reward of one epoch."""
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
    "tracking": TrackingReward(), "log-score": LogScore(), "paired": PairedReward(),
}  # fmt: skip


def reward_from(reward: str | Reward | PairedReward) -> Reward | PairedReward:
    """The reward of a ``reward=`` argument: a name, a function of (belief, truth), or paired."""
    function = reward.reward if isinstance(reward, PairedReward) else reward
    if isinstance(reward, str) or not callable(function):
        return choose(REWARDS, cast(str, reward), "reward")
    try:
        hash(function)
    except TypeError as error:
        raise ValueError(
            f"reward: found {function!r}, expected a hashable function or object"
        ) from error
    return reward
