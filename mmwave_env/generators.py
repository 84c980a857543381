"""Random states of many environments, small, and drawing from them in compiled code.

A numpy Generator takes 1 KB, and 3 KB once compiled code has drawn from it; its state takes 40
bytes. So states are kept, and one generator takes on one state after the other. numpy says where
a generator's state lies in memory (``bit_generator.ctypes``), so compiled code can do that, too.
"""

import ctypes
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from gymnasium.utils import seeding
from numba.extending import register_jitable
from numpy.typing import NDArray

Words = NDArray[np.uint64]
Index = NDArray[np.int64]


class Dice(NamedTuple):
    """What compiled code draws from: one generator, and the states that it takes on in turn.

    Attributes:
        rng: the generator.
        memory: (4,) its state where it lies.
        states: (n, 4) states, changed in place.
    """

    rng: np.random.Generator
    memory: Words
    states: Words


def dice_of(states: Words) -> Dice:
    """Dice that draw from states of PCG64 (n, 4)."""
    rng = np.random.Generator(np.random.PCG64(0))
    return Dice(rng, _memory(rng)[0], states)


def single(rng: np.random.Generator) -> Dice:
    """Dice that draw from one generator of any kind as it is."""
    return Dice(rng, np.zeros(4, np.uint64), np.zeros((1, 4), np.uint64))


@register_jitable
def take(dice, i):  # type: ignore[no-untyped-def]
    """Let the generator take on state i, which stays untouched until :func:`leave`."""
    rng, memory, states = dice
    for word in range(4):
        memory[word] = states[i, word]
    return rng


@register_jitable
def leave(dice, i):  # type: ignore[no-untyped-def]
    """Keep what the draws since :func:`take` made of state i."""
    _, memory, states = dice
    for word in range(4):
        states[i, word] = memory[word]


def _memory(rng: np.random.Generator) -> tuple[Words, Words]:
    """Where the state of a PCG64 lies: the state (4,), and what 32-bit draws left over (1,)."""
    address = rng.bit_generator.ctypes.state_address
    state = ctypes.c_void_p.from_address(address).value
    assert state is not None
    rest = address + ctypes.sizeof(ctypes.c_void_p)
    words = (ctypes.c_uint64 * 4).from_address(state), (ctypes.c_uint64 * 1).from_address(rest)
    return np.ctypeslib.as_array(words[0]), np.ctypeslib.as_array(words[1])


def _load(rng: np.random.Generator, words: Words) -> np.random.Generator:
    """Let a generator take on a state (5,) of :func:`_saved`."""
    state, rest = _memory(rng)
    state[:], rest[:] = words[:4], words[4:]
    return rng


def _saved(rng: np.random.Generator) -> Words:
    return np.concatenate(_memory(rng))


class Generators:
    """What N environments would have as ``np_random``.

    Args:
        n: number of environments.

    Raises:
        RuntimeError: numpy keeps the states of its generators elsewhere than thought.
    """

    def __init__(self, n: int) -> None:
        self._states = np.zeros((n, 5), np.uint64)
        self._seeds: list[int | None] = [None] * n
        self._rng, other = (np.random.Generator(np.random.PCG64(seed)) for seed in (0, 1))
        other.integers(9, dtype=np.int32)
        if _load(self._rng, _saved(other)).bit_generator.state != other.bit_generator.state:
            raise RuntimeError(
                f"numpy {np.__version__}: found the state of a PCG64 elsewhere than expected; "
                "please report it, and use another version until it is fixed"
            )

    def seed(self, place: int, seed: int | None) -> None:
        """Start an environment's generator as ``Env.reset`` does; None for any seed."""
        generator, self._seeds[place] = seeding.np_random(seed)
        self._states[place] = _saved(generator)

    def seeds(self) -> tuple[int, ...]:
        """(n,) the seeds the generators started from."""
        self._begin(range(len(self._seeds)))
        return tuple(seed for seed in self._seeds if seed is not None)

    def copies(self) -> tuple[np.random.Generator, ...]:
        """(n,) generators that draw what the environments will."""
        self._begin(range(len(self._seeds)))
        fresh = (np.random.Generator(np.random.PCG64(0)) for _ in self._seeds)
        return tuple(_load(rng, state) for rng, state in zip(fresh, self._states, strict=True))

    @contextmanager
    def states(self, places: Index) -> Iterator[Words]:
        """States (places, 4) of some environments to draw from; they are kept afterwards."""
        self._begin(places)
        states = self._states[places, :4]
        try:
            yield states
        finally:
            self._states[places, :4] = states

    def each(self, places: Index) -> Iterator[np.random.Generator]:
        """A generator to draw from for one environment, then for the next."""
        self._begin(places)
        for place in places:
            try:
                yield _load(self._rng, self._states[place])
            finally:
                self._states[place] = _saved(self._rng)

    def _begin(self, places: Iterable[int]) -> None:
        """Seed those that were not."""
        for place in places:
            if self._seeds[place] is None:
                self.seed(place, None)
