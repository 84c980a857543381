"""Advantage actor-critic (A2C) in the style of CleanRL: the complete algorithm in one file."""

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers.vector import NormalizeObservation

from experiments.evaluation.compare import compare

torch.manual_seed(0)
envs = NormalizeObservation(gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=64))
widths = (envs.single_observation_space.shape[0], 64)
actor = torch.nn.Sequential(
    torch.nn.Linear(*widths), torch.nn.Tanh(), torch.nn.Linear(64, int(envs.single_action_space.n))
)
critic = torch.nn.Sequential(torch.nn.Linear(*widths), torch.nn.Tanh(), torch.nn.Linear(64, 1))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3)
now = envs.reset(seed=10_000_000)[0]
over = np.zeros(64, bool)
for _ in range(1000):
    steps = []
    for _ in range(8):
        # the action after an episode's end is ignored
        state = torch.tensor(now)
        fresh = over
        choice = torch.distributions.Categorical(logits=actor(state))
        value = critic(state)[:, 0]
        action = choice.sample()
        now, reward, _, over, _ = envs.step(action.numpy())  # episodes end only by truncation
        steps.append([value, choice.log_prob(action), *map(torch.tensor, (reward, over, ~fresh))])
    values, chances, rewards, ends, counts = map(torch.stack, zip(*steps, strict=True))
    returns = torch.zeros(8, 64)
    ahead = critic(torch.tensor(now))[:, 0].detach()
    for t in reversed(range(8)):
        ahead = returns[t] = rewards[t] + 0.9 * torch.where(ends[t], values[t].detach(), ahead)
    gain = (returns - values)[counts]
    loss = (gain**2).mean() - (chances[counts] * gain.detach() / gain.std()).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def act(observations):
    scaled = (observations - envs.obs_rms.mean) / np.sqrt(envs.obs_rms.var + envs.epsilon)
    return actor(torch.tensor(scaled).float()).argmax(1).numpy()


print(compare({"a2c": act}, beside=("fixed-ukf",), episodes=200))
