"""Stable-Baselines3: PPO on the native vector environment."""

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from experiments.evaluation.compare import compare
from mmwave_env.sb3 import SB3VecEnv

torch.set_num_threads(1)  # the network is too small for more threads to help
envs = gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=64, autoreset_mode="SameStep")
envs = VecNormalize(SB3VecEnv(envs), norm_reward=False, gamma=0.95)
seed = 10_000_000  # the first training seed; seeds of test episodes start at 0
model = PPO("MlpPolicy", envs, n_steps=64, batch_size=1024, gamma=0.95, seed=seed, device="cpu")
model.learn(total_timesteps=200_000)


def act(observations):
    return model.predict(envs.normalize_obs(observations), deterministic=True)[0]


print(compare({"sb3-ppo": act}, beside=("fixed-ukf",), episodes=200))
