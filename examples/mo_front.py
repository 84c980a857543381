"""MO-Gymnasium: a front of position error against consistency, over constant weights of modes."""

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from mo_gymnasium.wrappers import MORecordEpisodeStatistics


class Terms(gym.Wrapper):
    """The environment with a vector as reward: minus the costs of error and of inconsistency."""

    def __init__(self, env):
        super().__init__(env)
        env.unwrapped.reward_space = Box(-np.inf, 0.0, (2,))  # where MO-Gymnasium looks

    def step(self, action):
        observation, _, *ends, info = self.env.step(action)
        return observation, info["reward_terms"][:2].astype(np.float32), *ends, info


env = gym.make("mmwave_env:MmWaveLoc-v0", beliefs="per-mode", action="weights")
env = MORecordEpisodeStatistics(Terms(env))


def terms(weights):
    """Return both terms per epoch, the mean of ten tuning episodes."""
    total = np.zeros(2)
    for seed in range(5_000_000, 5_000_010):
        env.reset(seed=seed)
        over = False
        while not over:
            *_, over, info = env.step(weights)
        total += info["episode"]["r"] / info["episode"]["l"] / 10
    return total


rng, found = np.random.default_rng(0), {(0.0,) * env.action_space.shape[0]: None}
for _ in range(100):
    *_, weights = found
    found[weights] = terms(np.array(weights))
    front = {w: t for w, t in found.items() if not any((o > t).all() for o in found.values())}
    parent = list(front)[rng.integers(len(front))]
    found[tuple(np.clip(parent + rng.normal(0.0, 0.5, len(parent)), -3.0, 3.0))] = None
    found = {w: t for w, t in found.items() if t is None or w in front}
for weights, (error, consistency) in sorted(front.items(), key=lambda row: row[1][0]):
    print(f"error {-error:.3f}, inconsistency {-consistency:.3f}: weights {np.round(weights, 1)}")
