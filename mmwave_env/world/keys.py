"""Keys of episodes: 64 bits that determine everything in a simulated episode.

The seed of an environment determines its *stream*, a number of 64 bits. The generator SplitMix64
(Steele, Lea and Flood 2014) starts at the stream, and its n-th output is the key of the n-th
episode. A key depends only on the stream and n, so any number of keys can be computed at once.
"""

import operator
from collections.abc import Iterable, Sequence
from math import inf
from typing import Annotated, Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mmwave_env.io.lookup import unknown
from mmwave_env.io.records import Bound, require
from mmwave_env.numerics.numbers import Index

Keys = NDArray[np.uint64]

_Seed = Annotated[int, Bound("an integer, 0 or more", least=0, most=inf)]
_STRIDE = np.uint64(0x9E3779B97F4A7C15)  # 2**64 / golden ratio, rounded to an odd number


def keys_at(streams: Keys, episodes: Keys) -> Keys:
    """Return the keys (n,) of episodes, given their streams (n,) or () and indices (from 0)."""
    # overflow is intended: arrays of integers wrap around
    bits = np.atleast_1d(streams) + (np.atleast_1d(episodes) + np.uint64(1)) * _STRIDE
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))  # type: ignore[no-any-return]


def stream_of(seed: int) -> np.uint64:
    """Return the stream of a seed."""
    return np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]  # type: ignore[no-any-return]


def keys_of(seeds: Iterable[int]) -> Keys:
    """Return, for each seed, the key of the episode that ``env.reset(seed=...)`` simulates."""
    streams = np.array([stream_of(seed) for seed in seeds], np.uint64)
    return keys_at(streams, np.zeros(len(streams), np.uint64))


def draw_key(rng: np.random.Generator) -> int:
    """Draw a key at random, for use where no seed is given."""
    return int(rng.integers(0, 2**64, dtype=np.uint64))


def key_from(key: Any) -> int:
    """Return an episode's key as an int; refuse anything but an integer from 0 to 2**64 - 1."""
    try:
        number = operator.index(key)
    except TypeError:
        number = -1
    if isinstance(key, bool | np.bool_) or not 0 <= number < 2**64:
        raise ValueError(f"episode_key: found {key!r}, expected an integer from 0 to 2**64 - 1")
    return number


def keys_from(keys: Any, n: int) -> Keys:
    """Return the keys (n,) of n environments; refuse wrong keys as :func:`key_from` does."""
    numbers = np.atleast_1d(np.asarray(keys, object))
    if numbers.shape != (n,):
        raise ValueError(
            f"options['episode_key']: found shape {np.shape(keys)}, expected ({n},), one per "
            "environment"
        )
    return np.array([key_from(key) for key in numbers], np.uint64)


def options_of(options: Any, *known: str) -> list[Any]:
    """Return the known entries of the dict in ``reset(options=...)``; None where one is missing."""
    named = {} if options is None else options
    if not isinstance(named, dict):
        raise ValueError(f"options: found {options!r}, expected a dict or None")
    for name in named:
        if name not in known:
            raise ValueError(unknown("options", name, known))
    return [named.get(name) for name in known]


class Streams:
    """The streams of n environments (random until seeded), and the numbers of keys drawn.

    Attributes:
        seeds: (n,) seeds of the streams; -1 where the seed is unknown.
    """

    def __init__(self, n: int) -> None:
        self._states = np.zeros((n, 2), np.uint64)  # streams, and numbers of keys drawn from them
        self._states[:, 0] = np.random.SeedSequence().generate_state(n, np.uint64)
        self.seeds = [-1] * n
        self._generators: list[np.random.Generator | None] = [None] * n

    def follow(self, place: int, rng: np.random.Generator, seed: int) -> None:
        """Start the stream of environment number ``place`` if it has another generator than before.

        After a seeded reset, a stream follows from the ``seed``. If the user set the generator,
        ``seed`` is -1, and the stream is drawn.
        """
        if rng is not self._generators[place]:
            self._generators[place] = rng
            self._states[place] = draw_key(rng) if seed == -1 else stream_of(seed), 0

    def seed_some(self, seed: int | Sequence[int | None] | None, places: Index) -> None:
        """Start the streams of the environments ``places``, as a vector environment's reset does.

        An integer s seeds environment i with s + i; None continues a stream.

        Raises:
            ValueError: seeds and environments differ in number, or a seed is no valid integer; no
                stream has changed then.
        """
        if seed is None:
            return
        n = len(self.seeds)
        if isinstance(seed, (int, np.integer)):
            seed = range(int(seed), int(seed) + n)
        seeds: Any = list(seed) if isinstance(seed, Sequence) else seed
        require("seed", seeds, tuple[_Seed | None, ...])
        if len(seeds) != n:
            raise ValueError(f"seed: found {len(seeds)} seeds, expected {n}, one per environment")
        for place in places:
            if seeds[place] is None:
                continue
            own = int(seeds[place])
            self.seeds[place] = own
            self._generators[place] = None
            self._states[place] = stream_of(own), 0

    def keys(self, places: Index) -> Keys:
        """Draw the next key of each environment in ``places``, which are distinct indices."""
        keys = keys_at(*self._states[places].T)
        self._states[places, 1] += np.uint64(1)
        return keys

    def generator(self, place: int) -> np.random.Generator:
        """Return the ``np_random`` of an environment; keys do not come from this generator."""
        generator = self._generators[place]
        seed = self.seeds[place]
        if generator is None:
            known = int(self._states[place, 0]) if seed == -1 else seed
            generator, _ = seeding.np_random(known)
            self._generators[place] = generator
        return generator
