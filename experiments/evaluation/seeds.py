"""Seeds of episodes: those of tests start at 0, those of tuning and training far away."""

from collections.abc import Sequence

import numpy as np

from mmwave_env.episodes.episode import Episode, EpisodeSource

TUNING_SEED = 5_000_000
TRAINING_SEED = 10_000_000  # of the first training; each has a million of its own
SEEDS_EACH = 1_000_000


def require_tuning_seed(seed: int) -> None:
    """Refuse to tune on test seeds.

    Raises:
        ValueError: naming the first tuning seed.
    """
    if seed < TUNING_SEED:
        raise ValueError(f"seed: found {seed}, expected a tuning seed >= {TUNING_SEED}")


def require_seeds(seeds: Sequence[int]) -> None:
    """Refuse an empty run, and seeds that are none.

    Raises:
        ValueError: no seeds, or a negative one.
    """
    if not len(seeds):
        raise ValueError("episodes: found none, expected at least 1")
    if min(seeds) < 0:
        raise ValueError(f"seed: found {min(seeds)}, expected 0 or more")


def draw_episodes(source: EpisodeSource, seeds: Sequence[int]) -> list[Episode]:
    """One episode per seed, the same that ``env.reset(seed=...)`` draws.

    Raises:
        ValueError: no seeds, or a negative one.
    """
    require_seeds(seeds)
    return [source.sample(np.random.default_rng(seed)) for seed in seeds]
