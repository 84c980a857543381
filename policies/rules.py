"""Policies that need no training: the paper's rule (Sec. III-A), and the most likely mode.

The paper's rule uses the EKF pipeline up to 2 m/s, and the UKF pipeline above.
"""

import warnings

import numpy as np

from mmwave_env.filters.modes import DESIGN_LIMIT_MPS
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import Policy
from mmwave_env.models.measurement import Epoch
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Array32, Index, Number, Vector, sqrt, where

SLOW_MPS = 2.0  # paper, Algorithm 1: mobility is low up to this speed


def mode_at(speed: Number, threshold: float = SLOW_MPS) -> Number:
    """Apply the paper's rule (Sec. III-A): return 0 up to the threshold, 1 above it."""
    return where(speed > threshold, 1.0, 0.0)


def by_predicted_speed(x: Vector, epoch: Epoch) -> Number:
    """Apply the rule to the speed in the state x (7,), which is also the predicted speed."""
    return mode_at(sqrt(dot(x[3:6], x[3:6])))


def by_odometry_speed(x: Vector, epoch: Epoch) -> Number:
    """Apply the rule to the odometry's speed; if it is missing, to the predicted speed."""
    return where(epoch.visible[-1] > 0.5, mode_at(epoch.z[-2]), by_predicted_speed(x, epoch))


class SpeedRule(Policy):
    """The paper's rule (Sec. III-A): choose mode 0 up to a threshold of the speed, else mode 1.

    Above 20 m/s, outside the paper's design window, the policy warns once and chooses mode 1.

    Args:
        observation: the environment's table of features.
        threshold: threshold of the speed, m/s; the paper uses 2 m/s.
    """

    def __init__(self, observation: Observation, threshold: float = SLOW_MPS) -> None:
        self.observation = observation
        self.threshold = threshold
        self._warned = False

    def act(self, observation: Array32) -> Index:
        """Return actions (n,)."""
        speed = self.observation.read(observation, "predicted speed")
        if not self._warned and (speed > DESIGN_LIMIT_MPS).any():
            self._warned = True
            warnings.warn(
                f"speed above {DESIGN_LIMIT_MPS:g} m/s is outside the design window of the paper's "
                "rule (speed-rule), which then chooses its mode for high mobility",
                stacklevel=2,
            )
        # Observations are float32: a speed at the threshold may be rounded to a value above it.
        threshold = min(self.threshold, DESIGN_LIMIT_MPS)
        return mode_at(speed, threshold * (1.0 + 1e-6)).astype(np.int64)  # type: ignore[no-any-return]


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
