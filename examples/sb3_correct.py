"""Stable-Baselines3: PPO (SAC if the argument is sac) learns to correct the policy `guided`."""

import sys
from functools import partial

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO, SAC

from mmwave_env.sb3 import SB3VecEnv
from policies import LearnedSwitch

torch.set_num_threads(1)  # the network is too small for more threads to help
guided = LearnedSwitch("guided")
task = {"id": "mmwave_env:MmWaveLoc-v0", "action": "correction"}
task |= {"beliefs": "per-mode", "modes": guided.bank(), "base": partial(LearnedSwitch, "guided")}
envs = SB3VecEnv(gym.make_vec(**task, num_envs=512, autoreset_mode="SameStep", reward="paired"))
usual = {"gamma": 0.0, "seed": 10_000_000, "device": "cpu"}  # corrections affect no later epoch
if "sac" in sys.argv:  # both algorithms explore only small corrections
    envs.action_space = gym.spaces.Box(envs.action_space.low / 8, envs.action_space.high / 8)
    usual |= {"gradient_steps": 4, "ent_coef": 3e-4, "policy_kwargs": {"net_arch": [64, 64]}}
    model = SAC("MlpPolicy", envs, 1e-3, 500_000, 50_000, 1024, **usual).learn(500_000)
else:
    usual["policy_kwargs"] = {"log_std_init": -2.0}
    model = PPO("MlpPolicy", envs, 1e-3, 16, 2048, 6, **usual).learn(2_000_000)


def reward(act, episodes=500):
    """Return the mean reward per epoch of each test episode, without its first ten epochs."""
    env = gym.make_vec(**task, num_envs=episodes)
    rewards = []
    (observations, _) = env.reset(seed=0)
    for _ in range(200):
        observations, earned, *_ = env.step(act(observations))
        rewards.append(earned)
    return np.mean(rewards[10:], axis=0)


mine = reward(lambda shown: model.predict(shown, deterministic=True)[0])
base = reward(lambda shown: np.zeros((len(shown), 6)))
print(f"sb3: reward {mine.mean():.3f}\nguided: reward {base.mean():.3f}")
print(f"difference: {np.mean(mine - base):.4f} ± {1.96 * np.std(mine - base) / 500**0.5:.4f}")
