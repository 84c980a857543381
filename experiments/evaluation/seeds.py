"""Which episodes are played, by seeds or by keys.

Seeds of tests start at 0, those of tuning and training far away.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from mmwave_env.world.episode import Episode, EpisodeSource
from mmwave_env.world.keys import Keys, key_from, keys_of

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
        found = seeds.stop - seeds.start if isinstance(seeds, range) else "none"
        raise ValueError(f"episodes: found {found}, expected at least 1")
    if min(seeds) < 0:
        raise ValueError(f"seed: found {min(seeds)}, expected 0 or more")


@dataclass(frozen=True)
class Selection:
    """Episodes of a source.

    Attributes:
        numbers: their seeds, one after the other, or their keys.
        keyed: whether they are keys.

    Raises:
        ValueError: no numbers, or a negative one.
    """

    numbers: Sequence[int]
    keyed: bool = False

    @classmethod
    def of(
        cls,
        source: EpisodeSource,
        episodes: int | None,
        seed: int | None,
        keys: Iterable[int] | None,
        usual: int,
    ) -> "Selection":
        """What a user asked for.

        Args:
            source: of the episodes.
            episodes: how many seeds; None for as many as ``usual``.
            seed: the first; None for 0.
            keys: of the episodes, in place of seeds; None for seeds.
            usual: how many where nobody says it.

        Raises:
            ValueError: no episode, a number that is no seed or key, a key twice, keys beside seeds
                or where episodes have none.
        """
        if keys is None:
            if episodes is not None and episodes < 1:
                raise ValueError(f"episodes: found {episodes}, expected at least 1")
            first = 0 if seed is None else seed
            return cls(range(first, first + (usual if episodes is None else episodes)))
        for name, value in (("seed", seed), ("episodes", episodes)):
            if value is not None:
                raise ValueError(
                    f"keys: found beside {name} {value}, expected keys alone: they say which "
                    "episodes, and how many"
                )
        selection = cls(_require_keys(keys), keyed=True)
        if selection.keys(source) is None:
            raise ValueError(
                f"keys: found {len(selection)}, but {source.name!r} is recorded or a source of "
                "your own; only simulated episodes have keys: expected none"
            )
        return selection

    def __post_init__(self) -> None:
        require_seeds(self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def __str__(self) -> str:
        if self.keyed:
            one, many = f"by its key {self.numbers[0]}", "by their keys"
        else:
            one, many = f"seed {self.numbers[0]}", f"seeds {self.numbers[0]} and up"
        if len(self) == 1:
            return f"1 episode, {one}, too few for intervals"
        return f"{len(self)} episodes{' ' if self.keyed else ', '}{many}"

    @property
    def json(self) -> dict[str, Any]:
        """As results files hold it."""
        which = {"keys": list(self.numbers)} if self.keyed else {"seed": self.numbers[0]}
        return {"episodes": len(self)} | which

    def part(self, first: int, count: int) -> "Selection":
        """Some of them."""
        return Selection(self.numbers[first : first + count], self.keyed)

    def seeds(self) -> list[int | None]:
        """(n,) None where a key says which episode it is."""
        return [None if self.keyed else number for number in self.numbers]

    def keys(self, source: EpisodeSource) -> Keys | None:
        """(n,) of simulated episodes; others have none."""
        from mmwave_env.world.simulated import SimulatedSource  # options are read without numba

        if type(source) is not SimulatedSource:
            return None
        return np.array(self.numbers, np.uint64) if self.keyed else keys_of(self.numbers)

    def draw(self, source: EpisodeSource) -> list[Episode]:
        """The episodes; those of seeds are the same that ``env.reset(seed=...)`` draws."""
        keys = self.keys(source)
        if keys is None:
            return [source.sample(np.random.default_rng(seed)) for seed in self.numbers]
        episodes: list[Episode] = cast(Any, source).episodes(keys)
        return episodes


def _require_keys(keys: Iterable[int]) -> tuple[int, ...]:
    """Keys as integers, which are some, each once."""
    if isinstance(keys, str) or not isinstance(keys, Iterable):
        raise ValueError(f"keys: found {keys!r}, expected a list of keys")
    try:
        numbers = tuple(map(key_from, keys))
    except ValueError as error:
        raise ValueError(f"keys: {error}") from None
    if not numbers:
        raise ValueError("keys: found none, expected at least 1")
    for key, times in Counter(numbers).items():
        if times > 1:
            raise ValueError(f"keys: found {key} {times} times, expected each key once")
    return numbers


def draw_episodes(source: EpisodeSource, seeds: Sequence[int]) -> list[Episode]:
    """One episode per seed, the same that ``env.reset(seed=...)`` draws.

    Raises:
        ValueError: no seeds, or a negative one.
    """
    return Selection(seeds).draw(source)
