"""What policies see, choose and earn, in many episodes at once."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.agents import require_actions
from experiments.evaluation.contenders import Contender
from mmwave_env.episodes.keys import Keys
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.vector_env import MmWaveLocVectorEnv
from policies import Policy

TOLD = ("position_error_m", "nees")  # infos that are kept
EPOCHS_AT_ONCE = 50_000  # 25 to 60 MB


class Transitions(NamedTuple):
    """Episodes (n,) of T epochs, as a policy went through them."""

    seeds: range  # (n,)
    keys: Keys | None  # (n,) of simulated episodes
    observations: NDArray[np.float32]  # (n, T + 1, features)
    actions: Index  # (n, T)
    rewards: Array  # (n, T)
    infos: dict[str, Array]  # of TOLD, (n, T + 1): NaN before the first step


def environments(episodes: int, epochs: int) -> int:
    """How many environments to collect episodes of so many epochs with: what fits into memory."""
    return max(1, min(episodes, EPOCHS_AT_ONCE // epochs))


def collect(contender: Contender, envs: MmWaveLocVectorEnv, seeds: range) -> Iterator[Transitions]:
    """A contender's way through the episodes that ``env.reset(seed=...)`` begins, to the last bit.

    Args:
        contender: that acts in such environments.
        envs: with ``autoreset_mode="Disabled"``; as many episodes are in memory at once.
        seeds: of the episodes, one after the other.

    Raises:
        ValueError: the policy was trained with other observations, at once; it returns no actions,
            in the part where it does.
    """
    assert contender.policy is not None  # those without choose nothing to collect
    policy = contender.policy(envs.observation)
    n = envs.num_envs
    return (
        _played(contender.name, policy, envs, seeds[first : first + n])
        for first in range(0, len(seeds), n)
    )


def _played(name: str, policy: Policy, envs: MmWaveLocVectorEnv, seeds: range) -> Transitions:
    """Episodes of as many seeds as there are environments, or fewer: those left are not kept."""
    n, T, table = len(seeds), envs.source.epochs, envs.observation
    observations = np.empty((n, T + 1, len(table)), np.float32)
    actions, rewards = np.empty((n, T), np.int64), np.empty((n, T))
    infos = {key: np.full((n, T + 1), np.nan) for key in TOLD}
    seen, begun = envs.reset(seed=seeds[0])
    policy.reset(np.ones(envs.num_envs, np.bool_))
    observations[:, 0] = seen[:n]
    for t in range(T):
        found = require_actions(name, policy(seen), envs.num_envs, len(table.actions))
        chosen = found.astype(np.int64)
        seen, earned, _, _, told = envs.step(chosen)
        observations[:, t + 1], actions[:, t], rewards[:, t] = seen[:n], chosen[:n], earned[:n]
        for key, values in infos.items():
            values[:, t + 1] = told[key][:n]
    keys = begun["episode_key"][:n] if "episode_key" in begun else None
    return Transitions(seeds, keys, observations, actions, rewards, infos)
