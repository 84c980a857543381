"""Keys of episodes: 64 bits from which everything in a simulated episode follows.

An environment draws the key of its next episode from the generator that Gymnasium seeds. Many
environments keep the bare states of their generators, 32 bytes each, which step all at once.
"""

import operator
from collections.abc import Iterable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mmwave_env.numerics.arrays import Index

Keys = NDArray[np.uint64]
Words = NDArray[np.uint64]

_LOW = np.uint64(2**32 - 1)
_HALF = np.uint64(32)
# PCG64 (O'Neill 2014), numpy's default: a congruential generator of 128 bits and its multiplier
_MULTIPLIER = (np.uint64(0x2360ED051FC65DA4), np.uint64(0x4385DF649FCCF645))


def draw_key(rng: np.random.Generator) -> int:
    """The key of the next episode of whoever owns the generator."""
    return int(rng.integers(0, 2**64, dtype=np.uint64))


def key_from(key: Any) -> int:
    """A key that a user gave.

    Raises:
        ValueError: no integer of 64 bits.
    """
    try:
        number = operator.index(key)
    except TypeError:
        number = -1
    if isinstance(key, bool | np.bool_) or not 0 <= number < 2**64:
        raise ValueError(f"episode_key: found {key!r}, expected an integer from 0 to 2**64 - 1")
    return number


def keys_from(keys: Any, n: int) -> Keys:
    """The keys (n,) that a user gave for as many environments.

    Raises:
        ValueError: not one an environment, or no integers of 64 bits.
    """
    given = np.atleast_1d(np.asarray(keys, object))
    if given.shape != (n,):
        raise ValueError(
            f"options['episode_key']: found shape {np.shape(keys)}, expected ({n},), one an "
            "environment"
        )
    return np.array([key_from(key) for key in given], np.uint64)


def option_of(options: Any, name: str) -> Any:
    """What ``reset(options=...)`` says under a name; None where it says nothing.

    Raises:
        ValueError: the options are no dict.
    """
    if options is not None and not isinstance(options, dict):
        raise ValueError(f"options: found {options!r}, expected a dict or None")
    return (options or {}).get(name)


def _product(a: Words, b: np.uint64) -> tuple[Words, Words]:
    """High and low words of the product of words."""
    a_high, a_low, b_high, b_low = a >> _HALF, a & _LOW, b >> _HALF, b & _LOW
    low = a_low * b_low
    middle = a_high * b_low + (low >> _HALF)
    other = a_low * b_high + (middle & _LOW)
    return a_high * b_high + (middle >> _HALF) + (other >> _HALF), a * b


def next_words(states: Words) -> Words:
    """The next words (n,) of generators PCG64, whose states are changed in place.

    Args:
        states: (n, 4) high and low words of state and increment.
    """
    high, low, add_high, add_low = states.T.copy()
    times_high, times_low = _MULTIPLIER
    product_high, product_low = _product(low, times_low)
    product_high = product_high + high * times_low + low * times_high
    low = product_low + add_low
    high = product_high + add_high + (low < product_low)
    states[:, 0], states[:, 1] = high, low
    turn = high >> np.uint64(58)
    word = high ^ low
    back = (np.uint64(64) - turn) & np.uint64(63)
    words: Words = (word >> turn) | (word << back)
    return words


class Generators:
    """What N environments would have as ``np_random``.

    Args:
        n: number of environments.
        bare: keep bare states, for :meth:`keys`; else generators, for :meth:`whole`.
    """

    def __init__(self, n: int, bare: bool = True) -> None:
        self._seeds: list[int | None] = [None] * n
        self._states: Words = np.zeros((n if bare else 0, 4), np.uint64)
        self._whole: list[np.random.Generator | None] = [None] * (0 if bare else n)

    def seed(self, place: int, seed: int | None) -> None:
        """Start an environment's generator as ``Env.reset`` does; None for any seed."""
        generator, self._seeds[place] = seeding.np_random(seed)
        if self._whole:
            self._whole[place] = generator
        else:
            self._states[place] = _words_of(generator)

    def seed_some(self, seed: int | Sequence[int | None] | None, places: Index) -> None:
        """Start the generators of some environments, as a vector environment's ``reset`` does.

        Args:
            seed: s for s + i of environment i; or one for each of all, None to go on.
            places: which start.

        Raises:
            ValueError: there is not one for each.
        """
        n = len(self._seeds)
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + i for i in range(n)]
        elif seed is not None and len(seed) != n:
            raise ValueError(f"seed: found {len(seed)} seeds, expected {n}, one an environment")
        if seed is None:
            return
        for place in places:
            if seed[place] is not None:
                self.seed(place, seed[place])

    def seeds(self) -> tuple[int, ...]:
        """(n,) the seeds the generators started from."""
        self._seed_missing(range(len(self._seeds)))
        return tuple(seed for seed in self._seeds if seed is not None)

    def copies(self) -> tuple[np.random.Generator, ...]:
        """(n,) generators that draw what the environments will."""
        self._seed_missing(range(len(self._seeds)))
        if self._whole:
            return tuple(deepcopy(rng) for rng in self._whole if rng is not None)
        return tuple(_generator_of(state) for state in self._states)

    def states(self) -> Words:
        """States (n, 4), where they are bare: a copy."""
        self._seed_missing(range(len(self._seeds)))
        return self._states.copy()

    def set_states(self, states: Words) -> None:
        """Take on states (n, 4); they came from no seed that is known."""
        self._states[:] = states
        self._seeds = [-1] * len(self._seeds)

    def keys(self, places: Index) -> Keys:
        """Keys (places,) of the next episodes of some environments."""
        self._seed_missing(places)
        states = self._states[places]
        keys = next_words(states)
        self._states[places] = states
        return keys

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


def _words_of(generator: np.random.Generator) -> list[int]:
    """High and low words of state and increment (4,) of a PCG64."""
    known: Any = generator.bit_generator.state["state"]
    return [part >> 64 if high else part % 2**64 for part in known.values() for high in (1, 0)]


def _generator_of(words: Words) -> np.random.Generator:
    generator = np.random.Generator(np.random.PCG64(0))
    state_high, state_low, step_high, step_low = words.tolist()
    state: Any = generator.bit_generator.state
    state["state"] = {
        "state": (state_high << 64) | state_low, "inc": (step_high << 64) | step_low
    }  # fmt: skip
    generator.bit_generator.state = state
    return generator
