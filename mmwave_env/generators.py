"""Random states of many environments, small.

A numpy Generator takes 1 KB, and 3 KB once compiled code has drawn from it; its state takes 48
bytes. So the states are kept, and a few generators take them on for the time of a draw.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

_MASK = 2**64 - 1


class Generators:
    """What N environments would have as ``np_random``.

    Args:
        n: number of environments.
    """

    def __init__(self, n: int) -> None:
        self._states = np.zeros((n, 6), np.uint64)
        self._seeds: list[int | None] = [None] * n
        self._lent: list[np.random.Generator] = []

    def seed(self, place: int, seed: int | None) -> None:
        """Start an environment's generator as ``Env.reset`` does; None for any seed."""
        generator, self._seeds[place] = seeding.np_random(seed)
        self._save(place, generator)

    def seeds(self) -> tuple[int, ...]:
        """(n,) the seeds the generators started from."""
        return tuple(self._seed_of(place) for place in range(len(self._seeds)))

    def copies(self) -> tuple[np.random.Generator, ...]:
        """(n,) generators that draw what the environments will."""
        return tuple(self._load(place, np.random.Generator(np.random.PCG64()))
                     for place in range(len(self._seeds)))  # fmt: skip

    @contextmanager
    def of(self, places: Sequence[int] | NDArray[np.int64]) -> Iterator[list[np.random.Generator]]:
        """Generators to draw from for some environments; their states are kept afterwards."""
        while len(self._lent) < len(places):
            self._lent.append(np.random.Generator(np.random.PCG64()))
        pairs = list(zip(places, self._lent, strict=False))
        try:
            yield [self._load(int(place), generator) for place, generator in pairs]
        finally:
            for place, generator in pairs:
                self._save(int(place), generator)

    def _seed_of(self, place: int) -> int:
        if self._seeds[place] is None:
            self.seed(place, None)
        seed = self._seeds[place]
        assert seed is not None
        return seed

    def _load(self, place: int, generator: np.random.Generator) -> np.random.Generator:
        self._seed_of(place)
        a, b, c, d, has, half = self._states[place].tolist()
        generator.bit_generator.state = {
            "bit_generator": "PCG64",
            "state": {"state": a << 64 | b, "inc": c << 64 | d},
            "has_uint32": has,
            "uinteger": half,
        }
        return generator

    def _save(self, place: int, generator: np.random.Generator) -> None:
        state = generator.bit_generator.state
        s, inc = state["state"]["state"], state["state"]["inc"]
        self._states[place] = (
            s >> 64, s & _MASK, inc >> 64, inc & _MASK, state["has_uint32"], state["uinteger"],
        )  # fmt: skip
