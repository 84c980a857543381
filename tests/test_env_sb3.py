"""MmWaveLoc-v0 as Stable-Baselines3 expects it."""

import warnings

import gymnasium as gym
import numpy as np
import pytest

import mmwave_env  # noqa: F401  registers the environment

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy

pytestmark = pytest.mark.torch

EKF = {"modes": ["ekf"]}


@pytest.mark.parametrize(
    "arguments",
    [{}, {"observation": "prior"} | EKF, {"odometry": True} | EKF,
     {"terminate_on_divergence": True, "episode_steps": 20}],
)  # fmt: skip
def test_stable_baselines3_s_checker_is_content(arguments):
    env = gym.make("MmWaveLoc-v0", **arguments)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
        check_env(env)


@pytest.mark.slow
@pytest.mark.slow
def test_ppo_learns_for_a_few_steps_and_is_evaluated_repeatably():
    env = gym.make("MmWaveLoc-v0", episode_steps=20)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    rewards = []
    for _ in range(2):
        watched = gym.wrappers.RecordEpisodeStatistics(gym.make("MmWaveLoc-v0", episode_steps=20))
        watched.reset(seed=0)
        rewards.append(evaluate_policy(model, watched, n_eval_episodes=1, warn=False)[0])
    assert np.isfinite(rewards[0]) and rewards[0] == rewards[1]
