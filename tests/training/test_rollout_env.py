"""Tests of the environments for training: RolloutEnv, which tries all actions, and PlacesVecEnv."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.interface.reward import TrackingReward
from tests.training.actors import MODES

pytest.importorskip("stable_baselines3")
from experiments.training.ppo import PlacesVecEnv
from experiments.training.rollouts import RolloutEnv
from experiments.training.training_task import Place, TrainingTask
from mmwave_env.interface.reward import PairedReward
from mmwave_env.sb3 import SB3VecEnv
from mmwave_env.vector_env import MmWaveLocVectorEnv
from tests.training.test_train import HYPER

pytestmark = pytest.mark.torch

SEED = 10_000_000
DISCOUNT = 0.9
HORIZON = 5
EPOCHS = 20  # number of epochs before all actions are tried
TUNED = Bank(tuple(replace(mode, sigma_v=1.5 * mode.sigma_v) for mode in MODES), nis_quantile=0.99)
BANKS = {"handset": Bank(MODES), "standard": TUNED}
PLACES = (Place("street", "handset"), Place("o1", "standard", 0.5))  # scene, radio, time step (s)


def task(beliefs="per-mode", places=PLACES, banks=BANKS):
    return TrainingTask("mixed", places, banks, "full", TrackingReward(), beliefs)


STREET = task(places=PLACES[:1], banks={"handset": Bank(default_modes("handset"))})


def environment(of=None):
    return RolloutEnv(of or task(), 16, HORIZON, DISCOUNT, SEED)


def chaotic(actions):
    """Return a policy whose actions change if the last digits of observations change."""
    return lambda observed: (np.abs(observed[:, 1:9]).sum(1) * 1e4).astype(np.int64) % actions


def stepped(env, epochs=EPOCHS):
    """Step an environment with random actions; return the actions (epochs, n)."""
    rng = np.random.default_rng(0)
    actions = rng.integers(len(env.observation.actions), size=(epochs, len(env.observations)))
    for now in actions:
        env.step(now)
    return actions


def replayed(place, seed, first_episode, actions, tried, act, beliefs):
    """Replay ``actions``, then take the action ``tried``; return the discounted reward since then.

    The first episode lasts ``first_episode`` epochs; the policy ``act`` chooses all later actions.
    """
    bank = BANKS[place.radio]
    modes = bank if beliefs == "per-mode" else bank.modes
    at = {"scene": place.scene, "radio": place.radio, "dt": place.dt}
    env = gym.make("MmWaveLoc-v0", **at, beliefs=beliefs, modes=modes)
    env.reset(seed=seed)
    for epoch, action in enumerate(actions):
        if epoch == first_episode:
            env.reset()
        env.step(action)
    value = 0.0
    action = tried
    for epoch in range(HORIZON):
        observed, reward, *_ = env.step(action)
        value += DISCOUNT ** (place.dt * epoch) * reward
        (action,) = act(observed[None])
    return value


@pytest.mark.parametrize(
    ("beliefs", "places"),
    [("per-mode", PLACES), ("shared", (PLACES[0], replace(PLACES[1], radio="handset")))],
)
def test_a_tried_action_earns_what_it_earns_in_a_separate_environment(beliefs, places):
    env = environment(task(beliefs, places, {p.radio: BANKS[p.radio] for p in places}))
    actions = stepped(env)
    count = len(env.observation.actions)
    tried = env.try_all(chaotic(count))
    assert tried.values.shape == (16, count) == (len(env.observations), count)
    assert_array_equal(tried.observations, env.observations)
    for i, place, first_episode in ((0, places[0], 1), (13, places[1], EPOCHS)):
        expected = [
            replayed(place, SEED + i, first_episode, actions[:, i], a, chaotic(count), beliefs)
            for a in range(count)
        ]
        assert_allclose(tried.values[i], expected, rtol=1e-9)
        assert np.ptp(expected) > 0.0


def test_trying_actions_does_not_change_the_environment():
    tries = environment()
    plain = environment()
    for env in (tries, plain):
        stepped(env)
    first = tries.try_all(chaotic(4))
    second = tries.try_all(chaotic(4))
    assert_array_equal(first.values, second.values)
    actions = np.random.default_rng(1).integers(4, size=(250, 16))
    for now in actions:
        tries.step(now)
        plain.step(now)
        assert_array_equal(tries.observations, plain.observations)


def test_states_near_the_end_of_an_episode_are_left_out():
    """Check 16 environments, of which the first eight end an episode after 201 epochs."""
    env = environment()
    for epochs, tried in ((200 - HORIZON + 1, 16), (1, 8), (HORIZON - 1, 16)):
        stepped(env, epochs)
        assert len(env.try_all(chaotic(4)).values) == tried


def test_the_normalization_is_measured_on_observations_of_the_environment():
    normal = environment(STREET).measured_normalization(6.0)
    again = environment(STREET)
    observed = []
    for _ in range(200):
        again.step(np.zeros(16, np.int64))
        observed.append(again.observations)
    assert_allclose(normal.mean, np.mean(observed, axis=(0, 1)), atol=1e-4)
    assert (normal.high - normal.mean) / normal.sigma == pytest.approx(6.0, rel=1e-4)


PAIR = MODES[:2]  # fast to compile
SLOWER = Bank(tuple(replace(mode, sigma_v=0.5 * mode.sigma_v) for mode in PAIR), None, 0.99)
TASK = task(banks={"handset": Bank(PAIR), "standard": SLOWER})
PAIRED = replace(HYPER, num_envs=5, paired=True)  # 3 environments at one place, 2 at the other


def alone(place, n):
    """Return n environments, as in a training run at this place alone."""
    arguments = TASK.arguments(place) | {"reward": PairedReward(TASK.reward)}
    return SB3VecEnv(MmWaveLocVectorEnv(n, **arguments, autoreset_mode="SameStep"))


def assert_same_ends(infos, expected):
    for x, y in zip(infos, expected, strict=True):
        assert x.get("episode", {}).get("r") == y.get("episode", {}).get("r")
        assert x.get("ate_m") == y.get("ate_m")
        last = (info.get("terminal_observation", 0) for info in (x, y))
        assert_array_equal(*last)


@pytest.mark.slow
def test_several_places_together_equal_each_place_alone():
    """Check places with different episode lengths; the second place's seeds follow the first's."""
    together = PlacesVecEnv(TASK, PAIRED)
    first = alone(PLACES[0], 3)
    second = alone(PLACES[1], 2)
    together.seed(10_000_000)
    first.seed(10_000_000)
    second.seed(10_000_003)
    observed = together.reset()
    theirs = [first.reset(), second.reset()]
    for _ in range(100):
        theirs[1], *_ = second.step(np.zeros(2, int))
    assert_array_equal(observed, np.concatenate(theirs))
    rng = np.random.default_rng(0)
    ends = []
    for t in range(210):
        actions = rng.integers(3, size=5)
        observed, rewards, over, infos = together.step(actions)
        a = first.step(actions[:3])
        b = second.step(actions[3:])
        for array, *parts in zip((observed, rewards, over), a, b, strict=False):
            assert_array_equal(array, np.concatenate(parts))
        assert_same_ends(infos, a[3] + b[3])
        ends += [(t, i) for i in np.flatnonzero(over)]
    assert ends == [(99, 3), (99, 4), (199, 0), (199, 1), (199, 2)]
