"""Tianshou: DQN on single environments, which Tianshou steps one after another."""

import gymnasium as gym
import torch
from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, VectorEnvNormObs
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net

from experiments.evaluation.compare import compare

torch.set_num_threads(1)
torch.manual_seed(0)
envs = DummyVectorEnv([lambda: gym.make("mmwave_env:MmWaveLoc-v0") for _ in range(16)])
envs = VectorEnvNormObs(envs)
envs.seed(10_000_000)
actions = envs.action_space[0]
net = Net(state_shape=envs.observation_space[0].shape, action_shape=actions.n, hidden_sizes=[64])
policy = DiscreteQLearningPolicy(model=net, action_space=actions, eps_training=0.1)
dqn = DQN(policy=policy, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.9, target_update_freq=500)
collector = Collector(dqn, envs, VectorReplayBuffer(50_000, 16), exploration_noise=True)
size = {"max_epochs": 1, "epoch_num_steps": 50_000, "batch_size": 256}
size |= {"collection_step_num_env_steps": 16, "update_step_num_gradient_steps_per_sample": 0.1}
dqn.run_training(OffPolicyTrainerParams(training_collector=collector, show_progress=False, **size))


def act(observations):
    observations = (observations - envs.obs_rms.mean) / (envs.obs_rms.var + 1e-8) ** 0.5
    return policy(Batch(obs=observations, info={})).act


print(compare({"dqn": act}, beside=("fixed-ukf",), episodes=200))
