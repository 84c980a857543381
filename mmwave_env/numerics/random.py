"""Random numbers, drawn by functions that run on floats and on SIMD lanes (eight environments).

The generator is SFC64 (Chris Doty-Humphrey, PractRand), as in numpy. It needs only additions,
shifts, a rotation and xor. Its state is four 64-bit words, stored as the bits of four floats. On
SIMD lanes, four vectors of eight floats store the states of eight environments.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mmwave_env.numerics.numbers import Number, Numbers, Vector, cos_sin, log, sqrt

STATE_WORDS = 4
_WARM_UP = 18  # number of first words that are dropped, because they still resemble the key


class Word(np.ndarray[Any, Any]):
    """An unsigned integer of 64 bits, whose arithmetic wraps around: an array (1,)."""

    def scaled(self, factor: float) -> float:
        """Convert the integer to a float, exactly if it is below 2^53, and multiply it."""
        return float(self[0]) * factor

    def as_number(self) -> float:
        """Return the float that has these bits."""
        return float(self.view(np.float64)[0])


def word_of(number: Number) -> Any:
    """Return the bits of a float or of lanes as words."""
    if isinstance(number, float):
        return np.array([number]).view(np.uint64).view(Word)
    return number.as_word()


def next_word(state: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Return the next word of SFC64 and the new state; each word is a Word or hidden."""
    a, b, c, counter = state
    word = a + b + counter
    rotated = (c << 24) | (c >> 40)
    return word, [b ^ (b >> 11), c + (c << 3), rotated + word, counter + 1]


def seeded(key: Number, stream: int) -> Numbers:
    """Return the generator's state (4,) for a key and the number of a stream.

    A key is a word of 64 bits, such as the key of an episode. ``key`` is the float (or lanes of
    floats) with these bits. Streams of one key are independent.
    """
    word = word_of(key)
    zero = word ^ word
    state = [word, word, zero + stream, zero + 1]
    for _ in range(_WARM_UP):
        _, state = next_word(state)
    return [word.as_number() for word in state]


class Dice:
    """A source of random numbers. They depend on the state (4,) and on the order of the draws."""

    def __init__(self, state: Vector) -> None:
        self._words = [word_of(number) for number in state]
        self._spare: Number | None = None  # second of a pair of normal numbers, drawn but not used

    @property
    def state(self) -> Numbers:
        """Return the generator's current state (4,)."""
        return [word.as_number() for word in self._words]

    def uniform(self, low: Number = 0.0, high: Number = 1.0) -> Number:
        """Draw uniformly from [low, high); for [0, 1), the result equals numpy's for this state."""
        word, self._words = next_word(self._words)
        return low + (high - low) * (word >> 11).scaled(2.0**-53)

    def exponential(self) -> Number:
        """Draw from the exponential distribution with mean 1; the result is at most 36.7."""
        return -log(1.0 - self.uniform())

    def normal(self) -> Number:
        """Draw a standard normal number, of absolute value up to 8.6 (Box and Muller 1958)."""
        if self._spare is not None:
            drawn = self._spare
            self._spare = None
            return drawn
        length = sqrt(2.0 * self.exponential())
        cosine, sine = cos_sin(2.0 * math.pi * self.uniform())
        self._spare = length * sine
        return length * cosine
