"""RLlib: PPO on normalized observations.

Without normalization, RLlib needs only the environment's id and `env_config`. The optional argument
(0 by default) is the number of the training run, which determines its seed.
"""

import sys
import time

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers.vector import NormalizeObservation
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.tune import register_env

from experiments.evaluation.compare import compare


def make(config):
    return NormalizeObservation(gym.make_vec("mmwave_env:MmWaveLoc-v0", **config))


begin = time.perf_counter()
number = int(sys.argv[1]) if sys.argv[1:] else 0
torch.set_num_threads(1)
register_env("mmwave", make)
config = PPOConfig().environment("mmwave", env_config={"radio": "handset"})
config.env_runners(
    num_env_runners=0, gym_env_vectorize_mode="vector_entry_point", num_envs_per_env_runner=64
)
config.learners(num_learners=0).debugging(seed=10_000_000 + 1_000_000 * number)
config.rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64], vf_share_layers=False))
config.training(gamma=0.9, lambda_=0.95, lr=1e-3, vf_clip_param=1000.0)  # returns are large
config.training(train_batch_size=4096, minibatch_size=1024, num_epochs=8)
ppo = config.build_algo()
for _ in range(100):
    ppo.train()
print(f"training {number}: {time.perf_counter() - begin:.0f} s")
envs = ppo.env_runner.env.env
module = ppo.get_module()


def act(observations):
    scaled = (observations - envs.obs_rms.mean) / np.sqrt(envs.obs_rms.var + envs.epsilon)
    outputs = module.forward_inference({"obs": torch.tensor(scaled).float()})
    return outputs["action_dist_inputs"].argmax(1).numpy()


print(compare({"rllib-ppo": act}, beside=("fixed-ukf", "speed-rule"), episodes=1000))
