"""Selection of episodes by their seeds.

Test seeds start at 0; seeds of tuning and training start far above them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from mmwave_env.io.files import Json
from mmwave_env.world.episode import Episode, EpisodeSource
from mmwave_env.world.keys import Keys, keys_of

TRAINING_SEED = 10_000_000  # first seed of the episodes for training
SEEDS_EACH = 1_000_000  # number of seeds reserved for the episodes of each training run


@dataclass(frozen=True)
class Selection:
    """A selection of a source's episodes, by their seeds.

    Raises:
        ValueError: there are no seeds, or a seed is negative.
    """

    seeds: Sequence[int]  # seed of each episode, in order

    @classmethod
    def of(cls, episodes: int | None, seed: int | None, usual: int) -> "Selection":
        """Return the episodes that a user asked for, by default ``usual`` episodes from seed 0."""
        first = seed or 0
        return cls(range(first, first + (usual if episodes is None else episodes)))

    def __post_init__(self) -> None:
        if not len(self.seeds):
            count = self.seeds.stop - self.seeds.start if isinstance(self.seeds, range) else 0
            raise ValueError(f"episodes: found {count}, expected at least 1")
        if min(self.seeds) < 0:
            raise ValueError(f"seed: found {min(self.seeds)}, expected 0 or more")

    def __len__(self) -> int:
        return len(self.seeds)

    def __str__(self) -> str:
        if len(self) == 1:
            return f"1 episode, seed {self.seeds[0]}, too few for intervals"
        return f"{len(self)} episodes, seeds {self.seeds[0]} and up"

    @property
    def json(self) -> Json:
        """Return the selection in the form that results files store."""
        return {"episodes": len(self), "seed": self.seeds[0]}

    def part(self, first: int, count: int) -> "Selection":
        """Return ``count`` of the episodes, from position ``first`` on."""
        return Selection(self.seeds[first : first + count])

    def keys(self, source: EpisodeSource) -> Keys | None:
        """Return the keys (n,) that determine simulated episodes; None for other episodes."""
        from mmwave_env.world.simulated import SimulatedSource  # slow: loads numba

        return keys_of(self.seeds) if type(source) is SimulatedSource else None

    def draw(self, source: EpisodeSource) -> list[Episode]:
        """Draw the episodes that ``env.reset(seed=...)`` also draws for these seeds."""
        keys = self.keys(source)
        if keys is None:
            return [source.sample(np.random.default_rng(seed)) for seed in self.seeds]
        episodes: list[Episode] = cast(Any, source).episodes(keys)
        return episodes


def draw_episodes(source: EpisodeSource, seeds: Sequence[int]) -> list[Episode]:
    """Draw one episode per seed; ``env.reset(seed=...)`` draws the same episodes."""
    return Selection(seeds).draw(source)
