"""The learner of rollout policy iteration, on states whose best action is known."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from experiments.training.actor import Normalization
from experiments.training.hyperparameters import RolloutHyperparameters
from experiments.training.rollout_env import Tried
from experiments.training.rollout_learner import RolloutLearner

pytestmark = pytest.mark.torch

FEATURES, ACTIONS = 4, 3
HYPER = RolloutHyperparameters(
    num_envs=8, horizon=2, gamma=0.9, stride=1, states=8, memory=512, gradient_steps=200,
    batch_size=128, learning_rate=0.01, ent_coef=0.001, final_fraction=0.1, hidden=(16,),
    clip_observation=6.0, first_action_bias=1.0,
)  # fmt: skip
MEAN, SIGMA = np.array([5.0, -3.0, 0.0, 1.0]), np.array([2.0, 0.1, 1.0, 30.0])
NORMAL = Normalization(MEAN - 6.0 * SIGMA, MEAN + 6.0 * SIGMA, MEAN, SIGMA)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def learner(hyper=HYPER, seed=0):
    torch.manual_seed(seed)
    return RolloutLearner(FEATURES, ACTIONS, hyper, NORMAL)


def states(n, seed, turned=False):
    """States where action 1 is best above the mean of the first feature, and action 2 below.

    All actions earn a large sum that depends on the state; which one is best is hidden in it.
    """
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, FEATURES))
    best = np.where((x[:, 0] > 0.0) != turned, 1, 2)
    values = rng.normal(0.0, 100.0, (n, 1)) + np.zeros(ACTIONS)
    values[np.arange(n), best] += abs(x[:, 0])
    return Tried((MEAN + SIGMA * x).astype(np.float32), values), best


def test_before_training_the_imm_decides():
    found, _ = states(100, 0)
    assert (learner().greedy(found.observations) == 0).all()


def test_it_learns_which_action_is_best():
    model, (found, _), (fresh, best) = learner(), states(512, 0), states(1000, 1)
    model.remember(found)
    told = model.improve(1.0)
    assert np.mean(model.greedy(fresh.observations) == best) > 0.95
    assert 0.0 < told["gain/expected"] < told["gain/possible"]
    again = model.improve(0.1)
    assert again["gain/expected"] > told["gain/expected"] and again["entropy"] < told["entropy"]


def test_draws_follow_the_probabilities():
    """As probable as the loss makes them: by hand, of one state."""
    model = learner(replace(HYPER, first_action_bias=2.0))
    one = np.repeat(states(1, 0)[0].observations, 4000, axis=0)
    x = torch.from_numpy(((one[:1] - MEAN) / SIGMA).astype(np.float32))
    expected = torch.softmax(model.network(x), 1).detach().numpy()[0]
    shares = np.bincount(model.sampled(one), minlength=ACTIONS) / len(one)
    np.testing.assert_allclose(shares, expected, atol=0.03)


def test_it_forgets_the_oldest_states():
    """Two memories full of states where the opposite holds, taken in unequal portions."""
    model, (fresh, best) = learner(), states(1000, 9, turned=True)
    model.remember(states(512, 0)[0])
    for seed, n in enumerate((300, 200, 12), start=1):
        model.remember(states(n, seed, turned=True)[0])
    told = model.improve(1.0)
    assert np.mean(model.greedy(fresh.observations) == best) > 0.95
    ideal = np.concatenate(
        [np.ptp(states(n, s, True)[0].values, axis=1) for s, n in ((1, 300), (2, 200), (3, 12))]
    )
    assert told["gain/possible"] == pytest.approx(ideal.mean(), rel=0.05)


def test_it_goes_on_to_the_last_bit():
    first, second = learner(), learner(seed=7)
    first.remember(states(300, 0)[0])
    first.improve(1.0)
    second.restore(first.state())
    rng = torch.get_rng_state()
    told = first.improve(0.5)
    torch.set_rng_state(rng)
    assert second.improve(0.5) == told
    for ours, theirs in zip(first.network.parameters(), second.network.parameters(), strict=True):
        assert torch.equal(ours, theirs)
