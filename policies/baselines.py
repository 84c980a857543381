"""A policy that needs no training: it chooses the most likely mode."""

import numpy as np

from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import Policy
from mmwave_env.numerics.numbers import Array32, Index


class LikelihoodRule(Policy):
    """A policy that chooses the mode that best explains recent measurements and the coming one.

    A mode's score is a moving average of its log-likelihood relative to the mode ``modes[-1]``.

    Args:
        observation: the environment's table of features; its kind must be "full" or "signed".
        modes: names of the modes, in order.
    """

    def __init__(self, observation: Observation, modes: list[str]) -> None:
        self.observation = observation
        self._features = [f"preference fast {name}" for name in modes[:-1]]

    def act(self, observation: Array32) -> Index:
        """Return actions (n,)."""
        against_last = [self.observation.read(observation, name) for name in self._features]
        scores = np.stack([*against_last, np.zeros(len(observation))], axis=-1)
        best: Index = scores.argmax(axis=-1)
        return best
