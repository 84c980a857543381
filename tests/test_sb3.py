"""Tests of the adapter to Stable-Baselines3, and of single environments with its checker."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import mmwave_env  # noqa: F401  registers the environment

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

from mmwave_env.sb3 import SB3VecEnv
from tests.paths import representative
from tests.refusals import refuses
from tests.training.actors import MODES

pytestmark = pytest.mark.torch

ID = "MmWaveLoc-v0"


def native(n=4, **arguments):
    arguments = {"modes": MODES, "episode_steps": 6} | arguments
    return gym.make_vec(ID, num_envs=n, autoreset_mode="SameStep", **arguments)


# --- against single environments

LOSING = {"scenario": "vehicle", "modes": MODES[:1]}
CONFIGURATIONS = {
    "truncated": {},
    "ends early": {"episode_steps": 20, "terminate_on_divergence": True} | LOSING,
    "log score": {"observation": "prior", "reward": "log-score", "odometry": True},
}


def assert_same(info, expected):
    """Check that infos are equal, except for rounding and wall times in ``episode``."""
    info, expected = dict(info), dict(expected)
    ours, theirs = info.pop("episode", None), expected.pop("episode", None)
    assert info.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_array_equal(info[key], value, err_msg=key)
    assert (ours is None) == (theirs is None)
    if ours:
        assert ours.keys() == theirs.keys() and ours["l"] == theirs["l"] and ours["t"] >= 0.0
        assert ours["r"] == pytest.approx(theirs["r"], rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("configuration", representative(CONFIGURATIONS, "ends early"))
def test_the_adapter_gives_the_same_results_as_a_dummy_vec_env(configuration):
    arguments = {"modes": MODES, "episode_steps": 6} | CONFIGURATIONS[configuration]
    ours = SB3VecEnv(native(4, **arguments))
    theirs = DummyVecEnv([lambda: Monitor(gym.make(ID, **arguments))] * 4)
    rng, ended, ways = np.random.default_rng(1), np.zeros(4, int), set()
    for venv in (ours, theirs):
        venv.seed(7)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    for _ in range(100):
        actions = rng.integers(ours.action_space.n, size=4)
        (*results, infos), (*expected, their_infos) = (v.step(actions) for v in (ours, theirs))
        for a, b in zip(results, expected, strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        for i, over in enumerate(results[2]):
            if over:
                assert_same(infos[i], their_infos[i])
                ways.add(infos[i]["TimeLimit.truncated"])
            else:
                assert infos[i] == {}
        ended += results[2]
    assert ended.min() >= 3
    assert ways == ({True, False} if configuration == "ends early" else {True})


def test_infos_of_any_vector_environment_are_passed_on():
    """Use Gymnasium's vector environment, a nested info, and an info that some steps leave out."""

    class Talkative(gym.Wrapper):
        def step(self, action):
            observation, reward, _, truncated, _ = self.env.step(action)
            info = {"always": reward, "nested": {"action": int(action)}}
            return observation, reward, False, truncated, info | ({"rare": "yes"} if action else {})

    def make():
        return Talkative(gym.make("CartPole-v1", max_episode_steps=3))

    env = gym.vector.SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    venv = SB3VecEnv(env)
    venv.seed(0)
    venv.reset()
    for _ in range(2):
        assert venv.step(np.array([0, 1]))[3] == [{}, {}]
    *_, (first, other) = venv.step(np.array([0, 1]))
    assert (first["always"], first["nested"], first["episode"]["l"]) == (1.0, {"action": 0}, 3)
    assert "rare" not in first and other["rare"] == "yes" and other["TimeLimit.truncated"]


# --- seeds, options, attributes


def test_seeds_and_options_are_used_for_one_reset():
    venv, env = SB3VecEnv(native()), native()
    venv.seed(3)
    venv.set_options({"reset_mask": np.ones(4, bool)})
    np.testing.assert_array_equal(venv.reset(), env.reset(seed=3)[0])
    np.testing.assert_array_equal(venv.reset(), env.reset()[0])
    venv.seed(3)
    np.testing.assert_array_equal(venv.reset(), env.reset(seed=[3, 4, 5, 6])[0])


def test_options_that_differ_between_environments_are_refused():
    venv = SB3VecEnv(native())
    venv.set_options([{"a": 1}, {}, {}, {}])
    with refuses("options"):
        venv.reset()


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_autoreset_modes_other_than_same_step_are_refused(mode):
    env = gym.make_vec(ID, num_envs=2, autoreset_mode=mode, modes=MODES)
    with refuses("autoreset_mode"):
        SB3VecEnv(env)


def test_an_environment_without_an_autoreset_mode_is_refused():
    env = gym.vector.VectorEnv()
    with refuses("autoreset_mode"):
        SB3VecEnv(env)


def test_attributes_and_methods_apply_to_all_environments():
    venv = SB3VecEnv(native())
    env = venv.env
    assert venv.get_attr("modes") == [MODES] * 4 and venv.get_attr("modes", [1, 2]) == [MODES] * 2
    assert venv.get_attr("num_envs", 0) == [4]
    assert not venv.has_attr("nothing")
    venv.set_attr("word", "x")
    assert env.word == "x"
    with refuses("set_attr('word')"):
        venv.set_attr("word", "y", 1)
    venv.reset()
    states = venv.env_method("state", indices=[0, 1, 2, 3])
    assert len(states) == 4 and all(state is states[0] for state in states)
    with refuses("env_method('state')"):
        venv.env_method("state", indices=[0])
    assert venv.env_is_wrapped(Monitor) == [True] * 4
    assert venv.env_is_wrapped(gym.wrappers.TimeLimit, [2]) == [False]


# --- wrappers of Stable-Baselines3


def test_wrappers_and_the_evaluation_of_stable_baselines3_work():
    with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):
        venv = VecMonitor(VecCheckNan(SB3VecEnv(native()), raise_exception=True))
    normal = VecNormalize(venv, norm_reward=False, clip_obs=6.0)
    model = PPO("MlpPolicy", normal, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    assert len(model.ep_info_buffer) == 4 * (32 // 6)
    assert {info["l"] for info in model.ep_info_buffer} == {6}
    assert abs(normal.obs_rms.mean).max() > 0.0 and normal.obs_rms.count > 128

    normal.training = False
    normal.seed(0)
    rewards, lengths = evaluate_policy(model, normal, 8, return_episode_rewards=True)
    env, now = native(), None
    now = env.reset(seed=0)[0]
    returns, expected = np.zeros(4), []
    for _ in range(12):
        actions, _ = model.predict(normal.normalize_obs(now), deterministic=True)
        now, reward, _, truncated, _ = env.step(actions)
        returns += reward
        if truncated.all():
            expected += returns.tolist()
            returns[:] = 0.0
    assert lengths == [6] * 8
    assert rewards == pytest.approx(expected, rel=1e-5)


# --- saving and restoring


def test_returns_and_lengths_of_episodes_continue_after_a_restore():
    first, second = SB3VecEnv(native()), SB3VecEnv(native())
    first.seed(0)
    first.reset()
    for _ in range(4):
        first.step(np.array([0, 1, 2, 0]))
    second.env.restore(first.env.state())
    second.restore(first.state())
    for _ in range(9):
        ended = [venv.step(np.array([2, 1, 0, 0]))[3] for venv in (first, second)]
        for a, b in zip(*ended, strict=True):
            assert [a.get("episode", {}).get(k) for k in "rl"] == [
                b.get("episode", {}).get(k) for k in "rl"
            ]


# --- single environments


@pytest.mark.parametrize("arguments", [{}, {"terminate_on_divergence": True, "episode_steps": 20}])
def test_single_environments_pass_the_checker_of_stable_baselines3(arguments):
    env = gym.make(ID, **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
        check_env(env)
