"""sb3-contrib: TRPO on the same vector environment as PPO in sb3_ppo.py."""

import gymnasium as gym
import torch
from sb3_contrib import TRPO
from stable_baselines3.common.vec_env import VecNormalize

from experiments.evaluation.compare import compare
from mmwave_env.sb3 import SB3VecEnv

torch.set_num_threads(1)
envs = gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=64, autoreset_mode="SameStep")
envs = VecNormalize(SB3VecEnv(envs), norm_reward=False, gamma=0.95)
seed = 10_000_000
model = TRPO("MlpPolicy", envs, n_steps=64, batch_size=1024, gamma=0.95, seed=seed, device="cpu")
model.learn(total_timesteps=200_000)


def act(observations):
    return model.predict(envs.normalize_obs(observations), deterministic=True)[0]


print(compare({"trpo": act}, beside=("fixed-ukf",), episodes=200))
