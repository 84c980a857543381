"""sb3-contrib: recurrent PPO, an agent with its own memory, learns to choose modes."""

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.vec_env import VecNormalize

from experiments.evaluation.compare import compare
from mmwave_env.sb3 import SB3VecEnv

torch.set_num_threads(1)
world = {"num_envs": 64, "autoreset_mode": "SameStep", "reward": "paired"}
envs = VecNormalize(SB3VecEnv(gym.make_vec("mmwave_env:MmWaveLoc-v0", **world)), norm_reward=False)
settings = {"n_steps": 50, "batch_size": 800, "gamma": 0.95, "seed": 10_000_000, "device": "cpu"}
model = RecurrentPPO("MlpLstmPolicy", envs, n_epochs=4, learning_rate=1e-3, **settings)
model.learn(total_timesteps=200_000)


class Remembering:
    """An agent that keeps the state of the network from one epoch to the next."""

    def reset(self, begins):
        """Forget the past; all episodes begin together."""
        self.state = None
        self.begins = begins

    def __call__(self, observations):
        """Return actions."""
        scaled = envs.normalize_obs(observations)
        actions, self.state = model.predict(scaled, self.state, self.begins, deterministic=True)
        self.begins = np.zeros(len(scaled), bool)
        return actions


print(compare({"recurrent-ppo": Remembering()}, beside=("fixed-ukf", "imm"), episodes=200))
