"""Seeds of episodes, and the episodes that they determine.

Test seeds start at 0; seeds of tuning and training start far above them.
"""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from experiments.console.options import USUAL_EPISODES
from mmwave_env.world.episode import Episode, EpisodeSource
from mmwave_env.world.keys import Keys, keys_of

TRAINING_SEED = 10_000_000  # first seed of the episodes for training
SEEDS_EACH = 1_000_000  # number of seeds reserved for the episodes of each training run


def seeds_from(episodes: int | None, seed: int | None, usual: int = USUAL_EPISODES) -> range:
    """Return the seeds that a user asked for, by default ``usual`` seeds from 0 on.

    Raises:
        ValueError: there are no seeds, or a seed is negative.
    """
    first = seed or 0
    count = usual if episodes is None else episodes
    if count < 1:
        raise ValueError(f"episodes: found {count}, expected at least 1")
    if first < 0:
        raise ValueError(f"seed: found {first}, expected 0 or more")
    return range(first, first + count)


def named(seeds: Sequence[int]) -> str:
    """Return the number of episodes and their seeds in words."""
    if len(seeds) == 1:
        return f"1 episode, seed {seeds[0]}, too few for intervals"
    return f"{len(seeds)} episodes, seeds {seeds[0]} and up"


def keys_for(source: EpisodeSource, seeds: Sequence[int]) -> Keys | None:
    """Return the keys (n,) that determine simulated episodes; None for other episodes."""
    from mmwave_env.world.simulated import SimulatedSource  # slow: loads numba

    return keys_of(seeds) if type(source) is SimulatedSource else None


def draw_episodes(source: EpisodeSource, seeds: Sequence[int]) -> list[Episode]:
    """Draw one episode per seed; ``env.reset(seed=...)`` draws the same episodes."""
    keys = keys_for(source, seeds)
    if keys is None:
        return [source.sample(np.random.default_rng(seed)) for seed in seeds]
    episodes: list[Episode] = cast(Any, source).episodes(keys)
    return episodes
