"""Tests of our adapter for Stable-Baselines3, and of the wrappers and checker of that library."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import mmwave_env  # noqa: F401  registers the environment

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

from mmwave_env.sb3 import SB3VecEnv
from tests.paths import representative
from tests.refusals import refuses
from tests.training.actors import MODES

pytestmark = pytest.mark.torch

ID = "MmWaveLoc-v0"


def native(**arguments):
    """Return a vector environment of four environments with short episodes."""
    arguments = {"modes": MODES, "episode_steps": 6} | arguments
    return gym.make_vec(ID, num_envs=4, autoreset_mode="SameStep", **arguments)


LOSING = {"scenario": "vehicle", "modes": MODES[:1]}
CONFIGURATIONS = {
    "truncated": {},
    "ends early": {"episode_steps": 20, "terminate_on_divergence": True} | LOSING,
    "log score": {"observation": "prior", "reward": "log-score", "odometry": True},
}


def assert_same(info, expected):
    """Check that the infos of an episode's end are equal, except for wall times and rounding."""
    assert info.keys() == expected.keys()
    for key in info.keys() - {"episode"}:
        assert_array_equal(info[key], expected[key], err_msg=key)
    ours = info["episode"]
    theirs = expected["episode"]
    assert ours.keys() == theirs.keys() and ours["l"] == theirs["l"] and ours["t"] >= 0.0
    assert ours["r"] == pytest.approx(theirs["r"], rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("configuration", representative(CONFIGURATIONS, "ends early"))
def test_the_adapter_gives_the_same_results_as_a_dummy_vec_env(configuration):
    arguments = {"modes": MODES, "episode_steps": 6} | CONFIGURATIONS[configuration]
    ours = SB3VecEnv(native(**arguments))
    theirs = DummyVecEnv([lambda: Monitor(gym.make(ID, **arguments))] * 4)
    rng = np.random.default_rng(1)
    ended = np.zeros(4, int)
    truncated = set()
    for venv in (ours, theirs):
        venv.seed(7)
    assert_array_equal(ours.reset(), theirs.reset())
    for _ in range(100):
        actions = rng.integers(ours.action_space.n, size=4)
        *results, infos = ours.step(actions)
        *expected, their_infos = theirs.step(actions)
        for a, b in zip(results, expected, strict=True):
            assert_array_equal(a, b)
            assert a.dtype == b.dtype
        for i, over in enumerate(results[2]):
            if over:
                assert_same(infos[i], their_infos[i])
                truncated.add(infos[i]["TimeLimit.truncated"])
            else:
                assert infos[i] == {}
        ended += results[2]
    assert ended.min() >= 3
    assert truncated == ({True, False} if configuration == "ends early" else {True})


def test_seeds_and_options_affect_only_the_next_reset():
    venv = SB3VecEnv(native())
    env = native()
    venv.seed(3)
    venv.set_options({"reset_mask": np.ones(4, bool)})
    assert_array_equal(venv.reset(), env.reset(seed=3)[0])
    assert_array_equal(venv.reset(), env.reset()[0])
    venv.seed(3)
    assert_array_equal(venv.reset(), env.reset(seed=[3, 4, 5, 6])[0])


def test_options_that_differ_between_environments_are_refused():
    venv = SB3VecEnv(native())
    venv.set_options([{"a": 1}, {}, {}, {}])
    with refuses("options"):
        venv.reset()


def test_autoreset_modes_other_than_same_step_are_refused():
    ours = [gym.make_vec(ID, num_envs=2, autoreset_mode=m) for m in ("NextStep", "Disabled")]
    for env in (*ours, gym.vector.VectorEnv()):  # a plain VectorEnv has no autoreset mode
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
    states = venv.env_method("belief", indices=[0, 1, 2, 3])
    assert len(states) == 4 and all(state is states[0] for state in states)
    with refuses("env_method('belief')"):
        venv.env_method("belief", indices=[0])
    assert venv.env_is_wrapped(Monitor) == [True] * 4
    assert venv.env_is_wrapped(gym.wrappers.TimeLimit, [2]) == [False]


def test_wrappers_of_stable_baselines3_work():
    with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):
        venv = VecMonitor(VecCheckNan(SB3VecEnv(native()), raise_exception=True))
    normal = VecNormalize(venv, norm_reward=False, clip_obs=6.0)
    model = PPO("MlpPolicy", normal, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    assert len(model.ep_info_buffer) == 4 * (32 // 6)
    assert {info["l"] for info in model.ep_info_buffer} == {6}
    assert abs(normal.obs_rms.mean).max() > 0.0 and normal.obs_rms.count > 128


@pytest.mark.parametrize("arguments", [{}, {"terminate_on_divergence": True, "episode_steps": 20}])
def test_single_environments_pass_the_checker_of_stable_baselines3(arguments):
    env = gym.make(ID, **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
        check_env(env)


def test_the_adapter_has_the_pictures_of_its_environments():
    venv = SB3VecEnv(native(render_mode="rgb_array"))
    venv.reset()
    pictures = venv.get_images()
    assert_array_equal(pictures, venv.env.render())
    assert venv.render("rgb_array").ndim == 3
