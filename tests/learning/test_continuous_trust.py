"""Continuous trust: of one mode it is the action of the environment, of all alike it is nothing."""

import numpy as np
import pytest

from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import score
from experiments.evaluation.seeds import TRAINING_SEED, draw_episodes
from experiments.learning.continuous_trust import TrustEngine, mean_factor, mean_trust
from mmwave_env.filters.bank import Bank, best_bank
from mmwave_env.filters.imm import TRUST
from mmwave_env.task import task_from
from policies import FixedMode

BANK = Bank(best_bank().modes[:2])
EPISODES = 3


class Actor:
    """A policy that knows its logits."""

    def __init__(self, logits):
        self._logits = np.array(logits, np.float32)

    def logits(self, observations):
        return np.tile(self._logits, (len(observations), 1))


def drawn(dt=1.0):
    task = task_from(beliefs="per-mode", modes=BANK, dt=dt, episode_steps=16)
    return draw_episodes(task.source, range(TRAINING_SEED, TRAINING_SEED + EPISODES))


def earned(episodes, logs):
    """Rewards with the same trust in every epoch."""
    engine = TrustEngine(BANK, episodes[0].layout, len(episodes))
    return engine.run(episodes, lambda seen: np.tile(logs, (len(seen), 1)))


@pytest.mark.slow
@pytest.mark.parametrize(("action", "dt"), [(0, 1.0), (2, 1.0), (1, 0.1)])
def test_trust_of_one_mode_is_the_action_of_the_environment(action, dt):
    episodes = drawn(dt)
    policy = FixedMode(action)
    agent = Contender("agent", BANK.modes, lambda table: policy, beliefs="per-mode")
    logs = TRUST * (np.arange(1, 3) == action)
    expected = score(agent, policy, episodes)["reward"]
    np.testing.assert_allclose(earned(episodes, logs), expected, atol=1e-9)


def test_trust_of_all_modes_alike_is_none():
    episodes = drawn()
    none, alike, one = (earned(episodes, logs) for logs in ([0.0, 0.0], [9.0, 9.0], [1.0, 0.0]))
    np.testing.assert_allclose(alike, none, atol=1e-9)
    assert np.abs(one - none).max() > 1e-6


def test_a_policy_that_is_sure_trusts_on_average_as_its_action_does():
    seen = np.zeros((2, 5), np.float32)
    for trust in (mean_trust, mean_factor):
        np.testing.assert_allclose(trust(Actor([0, 99, 0]))(seen), [[TRUST, 0.0]] * 2, atol=1e-6)
        np.testing.assert_allclose(trust(Actor([99, 0, 0]))(seen), np.zeros((2, 2)), atol=1e-6)


def test_trust_is_in_proportion_to_probabilities_and_the_mean_factor_is_larger():
    seen, actor = np.zeros((1, 5), np.float32), Actor(np.log([0.5, 0.3, 0.2]))
    logs = mean_trust(actor)(seen)
    np.testing.assert_allclose(logs, TRUST * np.array([[0.3, 0.2]]), rtol=1e-5)
    factor = 1.0 + np.array([[0.3, 0.2]]) * (np.exp(TRUST) - 1.0)
    np.testing.assert_allclose(np.exp(mean_factor(actor)(seen)), factor, rtol=1e-5)
    assert (factor > np.exp(logs)).all()  # Jensen
