"""Random states of many environments, small, and drawing from them in compiled code.

Looking into a numpy Generator costs compiled code more than a whole track of a user; its state
takes 32 bytes. So states are kept, and one generator takes on one state after the other. numpy
says where the state lies in memory (``bit_generator.ctypes``), so compiled code can do that.
"""

import ctypes
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import NamedTuple

import numpy as np
from gymnasium.utils import seeding
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.numerics.arrays import Index

Words = NDArray[np.uint64]


_own = threading.local()  # a generator of each thread, and where its state lies


class RngView(NamedTuple):
    """What compiled code draws from: one generator, and the states that it takes on in turn."""

    rng: np.random.Generator  # the generator
    memory: Words  # (4,) its state where it lies
    states: Words  # (n, 4) states, changed in place


def rng_view(states: Words) -> RngView:
    """Dice that draw from states of PCG64 (n, 4), for this thread and until it asks for others."""
    if not hasattr(_own, "rng"):  # a new one takes as long as half an episode
        _own.rng = np.random.Generator(np.random.PCG64(0))
        _own.memory = _memory(_own.rng)
    return RngView(_own.rng, _own.memory, states)


def whole_rng(rng: np.random.Generator) -> RngView:
    """Dice that draw from one generator of any kind as it is."""
    return RngView(rng, np.zeros(4, np.uint64), np.zeros((1, 4), np.uint64))


@register_jitable
def load_state(view, i):  # type: ignore[no-untyped-def]
    """Let the generator take on state i, which stays untouched until :func:`save_state`."""
    rng, memory, states = view
    for word in range(4):
        memory[word] = states[i, word]
    return rng


@register_jitable
def save_state(view, i):  # type: ignore[no-untyped-def]
    """Keep what the draws since :func:`load_state` made of state i."""
    _, memory, states = view
    for word in range(4):
        states[i, word] = memory[word]


def _memory(rng: np.random.Generator) -> Words:
    """State and increment (4,) of a PCG64, where they lie."""
    state = ctypes.c_void_p.from_address(rng.bit_generator.ctypes.state_address).value
    assert state is not None
    return np.ctypeslib.as_array((ctypes.c_uint64 * 4).from_address(state))


def _require_known_memory() -> None:
    one, other = (np.random.Generator(np.random.PCG64(seed)) for seed in (0, 1))
    _memory(one)[:] = _memory(other)
    if one.bit_generator.state != other.bit_generator.state:
        raise RuntimeError(
            f"numpy {np.__version__}: found the state of a PCG64 elsewhere than expected; please "
            "report it, and use another version until it is fixed"
        )


class Generators:
    """What N environments would have as ``np_random``.

    Args:
        n: number of environments.
        small: keep bare states, for :meth:`states`; else generators, for :meth:`whole`.

    Raises:
        RuntimeError: numpy keeps the states of its generators elsewhere than thought.
    """

    def __init__(self, n: int, small: bool = True) -> None:
        self._seeds: list[int | None] = [None] * n
        self._states = np.zeros((n if small else 0, 4), np.uint64)
        self._whole: list[np.random.Generator | None] = [None] * (0 if small else n)
        if small:
            _require_known_memory()

    def seed(self, place: int, seed: int | None) -> None:
        """Start an environment's generator as ``Env.reset`` does; None for any seed."""
        generator, self._seeds[place] = seeding.np_random(seed)
        if self._whole:
            self._whole[place] = generator
        else:
            self._states[place] = _memory(generator)

    def seeds(self) -> tuple[int, ...]:
        """(n,) the seeds the generators started from."""
        self._seed_missing(range(len(self._seeds)))
        return tuple(seed for seed in self._seeds if seed is not None)

    def copies(self) -> tuple[np.random.Generator, ...]:
        """(n,) generators that draw what the environments will."""
        self._seed_missing(range(len(self._seeds)))
        if self._whole:
            return tuple(deepcopy(rng) for rng in self._whole if rng is not None)
        fresh = tuple(np.random.Generator(np.random.PCG64(0)) for _ in self._seeds)
        for rng, state in zip(fresh, self._states, strict=True):
            _memory(rng)[:] = state
        return fresh

    def bare(self) -> Words:
        """States (n, 4), where they are bare: a copy."""
        self._seed_missing(range(len(self._seeds)))
        return self._states.copy()

    def set_bare(self, states: Words) -> None:
        """Take on states (n, 4); they came from no seed that is known."""
        self._states[:] = states
        self._seeds = [-1] * len(self._seeds)

    @contextmanager
    def states(self, places: Index) -> Iterator[Words]:
        """States (places, 4) of some environments to draw from; they are kept afterwards."""
        self._seed_missing(places)
        states = self._states[places]
        try:
            yield states
        finally:
            self._states[places] = states

    def whole(self, place: int) -> np.random.Generator:
        """The generator of an environment, for any use."""
        self._seed_missing([place])
        generator = self._whole[place]
        assert generator is not None
        return generator

    def _seed_missing(self, places: Iterable[int]) -> None:
        for place in places:
            if self._seeds[place] is None:
                self.seed(place, None)
