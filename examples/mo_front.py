"""MO-Gymnasium: the Pareto front of position error and consistency, for constant mode weights."""

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from mo_gymnasium.wrappers import MORecordEpisodeStatistics


class Terms(gym.Wrapper):
    """The environment with a vector as reward: minus the costs of error and of inconsistency."""

    def __init__(self, env):
        super().__init__(env)
        env.unwrapped.reward_space = Box(-np.inf, 0.0, (2,))  # MO-Gymnasium reads this

    def step(self, action):
        """Step the environment; return the terms of error and inconsistency as the reward."""
        observation, _, *ends, info = self.env.step(action)
        return observation, info["reward_terms"][:2].astype(np.float32), *ends, info


options = {"beliefs": "per-mode", "modes": ["ekf", "ukf"], "action": "weights"}
env = MORecordEpisodeStatistics(Terms(gym.make("mmwave_env:MmWaveLoc-v0", **options)))


def terms(weights):
    """Return both terms of the reward per epoch, averaged over ten tuning episodes."""
    total = np.zeros(2)
    for seed in range(5_000_000, 5_000_010):
        env.reset(seed=seed)
        over = False
        while not over:
            *_, over, info = env.step(weights)
        total += info["episode"]["r"] / info["episode"]["l"] / 10
    return total


tried = [(terms(weights), weights) for weights in np.random.default_rng(0).uniform(-1, 1, (40, 2))]
front = [(t, w) for t, w in tried if not any((other > t).all() for other, _ in tried)]
for (error, consistency), weights in sorted(front, key=lambda row: row[0][0]):
    print(f"error {-error:.3f}, inconsistency {-consistency:.4f}: weights {weights.round(2)}")
