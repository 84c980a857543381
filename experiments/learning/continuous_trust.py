"""Trust as a number for every mode, where the environment offers one mode to trust at a time.

An action multiplies the probability of one mode by exp(:data:`~mmwave_env.filters.imm.TRUST`) a
second. Here any factors may be given. They are applied to the mode probabilities in the state of
the engine, between two epochs, and the engine then takes action 0, which leaves them as they are.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import rows_of
from mmwave_env.engines.env_engine import Engine
from mmwave_env.episodes.episode import Episode, EpisodeBatch
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.imm import TRUST, step_weight
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.metrics import scored
from mmwave_env.models.measurement import Layout
from mmwave_env.numerics.arrays import Array
from mmwave_env.reward import TrackingReward
from policies import LearnedSwitch

NONE = np.int64(0)  # the action that trusts no mode
_LEAST = 1e-12  # probability of a mode, as in the IMM

# Observations (n, features) to logarithms of the factors (n, modes) on mode probabilities, over a
# second.
Trust = Callable[[NDArray[np.float32]], Array]


class TrustEngine:
    """N environments in which every mode keeps its own belief and trust is continuous.

    Args:
        bank: of the modes.
        layout: rows of the measurements.
        n: number of environments.

    Attributes:
        observation: the table of features that trust depends on.
    """

    def __init__(self, bank: Bank, layout: Layout, n: int) -> None:
        self._engine = Engine(Pipeline(bank.modes, layout), n, TrackingReward(), bank=bank)
        self._reward_row = rows_of(self._engine.at.reward)
        self._everywhere = np.arange(n)
        self.observation = self._engine.observation

    def run(self, episodes: EpisodeBatch | Sequence[Episode], trust: Trust) -> Array:
        """Mean reward (n,) over the epochs that are scored, of episodes of one length."""
        engine, places = self._engine, self._everywhere
        engine.load(episodes, places)
        observations, _ = engine.start(places)
        rewards = np.empty((len(places), int(engine.batch.state.length[0])))
        for t in range(rewards.shape[1]):
            self._give(trust(observations))
            observations, told = engine.step(NONE, self._reward_row)
            rewards[:, t] = told[:, 0]
        mean: Array = rewards[:, scored(rewards.shape[1])].mean(axis=1)
        return mean

    def _give(self, logs: Array) -> None:
        """Multiply mode probabilities by exp(logs (n, modes) * step) and normalize them."""
        engine = self._engine
        logs = logs * step_weight(engine.read(engine.at.pending.dt))[:, None]
        logs = logs - logs.max(axis=1, keepdims=True)  # a common factor changes nothing
        weights = np.maximum(engine.read(engine.at.mixture.probability) * np.exp(logs), _LEAST)
        trusted = weights / weights.sum(axis=1, keepdims=True)
        engine.batch.write(engine.at.mixture.probability, trusted)


def mean_trust(switch: LearnedSwitch) -> Trust:
    """Trust in proportion to the probabilities of a policy's actions: the mean of the logarithm."""
    return lambda observations: TRUST * _probabilities(switch, observations)[:, 1:]


def mean_factor(switch: LearnedSwitch) -> Trust:
    """The mean of the factor itself over a policy's actions, of a step of one second."""
    gain = np.expm1(TRUST)
    return lambda observations: np.log1p(gain * _probabilities(switch, observations)[:, 1:])


def _probabilities(switch: LearnedSwitch, observations: NDArray[np.float32]) -> Array:
    """Of a policy's actions (n, actions)."""
    logits = switch.logits(observations).astype(float)
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    found: Array = odds / odds.sum(axis=1, keepdims=True)
    return found
