"""Tests of rollout policy iteration: interruptions, policy files, and learning."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch

from experiments.training.hyperparameters import RolloutHyperparameters
from experiments.training.rollouts import RolloutLearner, RolloutTrainer, Tried
from experiments.training.run import train
from policies import LearnedSwitch
from policies.sb3 import Normalization
from tests.training import test_train
from tests.training.test_rollout_env import PLACES, STREET, task
from tests.training.test_train_interrupted import assert_goes_on, silent, trained

pytestmark = pytest.mark.torch

HYPER = RolloutHyperparameters(
    num_envs=16, horizon=3, gamma=0.95, stride=2, states=64, memory=200, gradient_steps=3,
    batch_size=64, learning_rate=0.01, ent_coef=0.002, final_fraction=0.1, hidden=(8, 8),
    clip_observation=6.0, first_action_bias=0.0,
)  # fmt: skip


job_of = partial(test_train.job_of, task=task(), hyperparameters=HYPER, timesteps=10 * HYPER.states)


@pytest.mark.slow
def test_an_interrupted_training_goes_on(tmp_path):
    assert_goes_on(job_of(tmp_path))


def test_the_policy_file_chooses_the_actions_of_the_network(tmp_path):
    job = job_of(tmp_path, timesteps=RolloutTrainer.EVERY * HYPER.states)  # evaluated at the end
    learner = trained(job, RolloutTrainer)
    env = learner.env
    policy = LearnedSwitch(job.policy, env.observation)
    assert policy.card.timesteps >= job.timesteps and policy.card.algorithm == "rollouts"
    assert set(policy.card.banks) == {place.radio for place in PLACES}
    alike = []
    taken = set()
    for _ in range(100):
        actions = learner.greedy(env.observations)
        alike.append(actions == policy.act(env.observations))
        taken |= set(actions.tolist())
        env.step(actions)
    assert np.mean(alike) > 0.999 and len(taken) > 1


# --- a short training

LARGE = replace(HYPER, num_envs=128, horizon=8, states=4096, memory=40_000, gradient_steps=40)
QUICK = replace(LARGE, batch_size=1024, learning_rate=0.002, hidden=(32, 32), first_action_bias=1.0)


@pytest.mark.slow
def test_a_short_training_from_scratch_beats_the_speed_rule_and_the_imm(tmp_path):
    """Train a policy with the speed rule's modes; at first, the policy acts like their IMM."""
    job = job_of(tmp_path, task=STREET, hyperparameters=QUICK, timesteps=60_000, episodes=500)
    best = train(job, silent)["best"]
    for rival in ("speed-rule", "imm"):
        low, high = best[f"minus {rival}"]["ci95"]
        assert 0.0 < low < high


# --- the learner, on states whose best action is known

FEATURES = 4
ACTIONS = 3
LEARNING = replace(
    HYPER, memory=512, gradient_steps=200, batch_size=128, hidden=(16,), first_action_bias=1.0
)
MEAN = np.array([5.0, -3.0, 0.0, 1.0])
SIGMA = np.array([2.0, 0.1, 1.0, 30.0])
NORMAL = Normalization(MEAN - 6.0 * SIGMA, MEAN + 6.0 * SIGMA, MEAN, SIGMA)


def learner(hyper=LEARNING):
    torch.manual_seed(0)
    return RolloutLearner(FEATURES, ACTIONS, hyper, NORMAL)


def states(n, seed, turned=False):
    """Return states and their best actions: 1 if feature 0 is above its mean, else 2.

    ``turned`` swaps the two actions. In each state, all actions earn the same large random sum, and
    the best action a little more.
    """
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, FEATURES))
    best = np.where((x[:, 0] > 0.0) != turned, 1, 2)
    values = rng.normal(0.0, 100.0, (n, 1)) + np.zeros(ACTIONS)
    values[np.arange(n), best] += abs(x[:, 0])
    return Tried((MEAN + SIGMA * x).astype(np.float32), values), best


def test_before_training_the_learner_leaves_decisions_to_the_imm():
    tried, _ = states(100, 0)
    assert (learner().greedy(tried.observations) == 0).all()


def test_sampled_actions_follow_the_probabilities_of_the_network():
    model = learner(replace(LEARNING, first_action_bias=2.0))
    state = np.repeat(states(1, 0)[0].observations, 4000, axis=0)
    x = torch.from_numpy(((state[:1] - MEAN) / SIGMA).astype(np.float32))
    expected = torch.softmax(model.network(x), 1).detach().numpy()[0]
    shares = np.bincount(model.sampled(state), minlength=ACTIONS) / len(state)
    np.testing.assert_allclose(shares, expected, atol=0.03)


def test_the_learner_learns_which_action_is_best_and_forgets_the_oldest_states():
    """Fill the memory, then replace all states with states in which the other action is best."""
    model = learner()
    fresh, best = states(1000, 9)
    model.remember(states(512, 0, turned=True)[0])
    for seed, n in enumerate((300, 200, 12), start=1):
        model.remember(states(n, seed)[0])
    for left in (1.0, 0.1):
        model.improve(left)
        assert np.mean(model.greedy(fresh.observations) == best) > 0.95
