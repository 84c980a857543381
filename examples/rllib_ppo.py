"""RLlib: PPO; the id with `env_config` does as well, here observations are normalized, too."""

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


register_env("mmwave", make)
config = PPOConfig().environment("mmwave", env_config={"radio": "handset"})
config.env_runners(
    num_env_runners=0, gym_env_vectorize_mode="vector_entry_point", num_envs_per_env_runner=64
)
config.learners(num_learners=0).debugging(seed=10_000_000)
config.rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64]))
config.training(gamma=0.9, lr=1e-3, train_batch_size=4096, minibatch_size=1024, num_epochs=6)
ppo = config.build_algo()
for _ in range(25):
    ppo.train()
envs, module = ppo.env_runner.env.env, ppo.get_module()


def act(observations):
    scaled = (observations - envs.obs_rms.mean) / np.sqrt(envs.obs_rms.var + envs.epsilon)
    outputs = module.forward_inference({"obs": torch.tensor(scaled).float()})
    return outputs["action_dist_inputs"].argmax(1).numpy()


print(compare({"rllib-ppo": act}, beside=("fixed-ukf",), episodes=200))
