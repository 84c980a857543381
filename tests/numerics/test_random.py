"""Tests of random numbers against NumPy's generator, and of the numbers of similar keys."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, fill, rows_of
from mmwave_env.numerics.random import Dice, next_word, seeded, word_of

_BITS = 2 ** np.arange(64, dtype=np.uint64)
_FIRST = np.arange(40, dtype=np.uint64)
KEYS = np.concatenate([_FIRST, _BITS, ~_FIRST[:24]])
EACH = 8  # numbers that one run of DRAWER draws from each of the three distributions


def number(key):
    """Return the float that has the bits of a key."""
    return float(np.uint64(key).view(np.float64))


def theirs(key, stream):
    """Return NumPy's generator, seeded like :class:`Dice`, after dropping its first 18 words."""
    bits = np.random.SFC64(0)
    state = bits.state
    state["state"]["state"] = np.array([key, key, stream, 1], np.uint64)
    bits.state = state
    bits.random_raw(18)
    return bits


@pytest.mark.parametrize("stream", [0, 1])
def test_random_words_equal_numpys_random_words(stream):
    for key in KEYS:
        state = [word_of(each) for each in seeded(number(key), stream)]
        expected = theirs(key, stream)
        for _ in range(20):
            word, state = next_word(state)
            assert word[0] == expected.random_raw()


def _draw(w):
    """Return the workspace after a run: no inputs, the state of the dice, and the drawn numbers."""
    nothing, state, *_ = w
    dice = Dice(state)
    uniform = [dice.uniform() for _ in range(EACH)]
    exponential = [dice.exponential() for _ in range(EACH)]
    normal = [dice.normal() for _ in range(EACH)]
    return [nothing, dice.state, uniform, exponential, normal]


def _seed(w):
    return [w[0], seeded(w[0][0], 0)]


SEEDER = Program(_seed, [[0.0], [0.0] * 4])
DRAWER = Program(_draw, [[], [0.0] * 4, *[[0.0] * EACH] * 3])


def drawn(keys, runs):
    """Draw uniform, exponential and normal numbers (3, keys, runs * 8) on SIMD lanes."""
    n = len(keys)
    rows = blocks_of(SEEDER.start, n)
    io = StepIO.of(n, 1, output_rows=rows_of(SEEDER.index[1]))
    SEEDER.run_on_lanes(BatchState.of(keys.view(np.float64).reshape(n, 1, 1), rows), io)
    rows = fill(blocks_of(DRAWER.start, n), rows_of(DRAWER.index[1]), io.outputs[:, 0])
    io = StepIO.of(n, runs, output_rows=rows_of(DRAWER.index[2:]))
    DRAWER.run_on_lanes(BatchState.of(np.empty((n, runs, 0)), rows), io)
    return io.outputs.reshape(n, runs, 3, EACH).transpose(2, 0, 1, 3).reshape(3, n, -1)


def test_lanes_draw_the_same_numbers_as_floats_and_numpy():
    numbers = drawn(KEYS, 3)
    for key, uniform, exponential, normal in zip(KEYS, *numbers, strict=True):
        dice = Dice(seeded(number(key), 0))
        rng = np.random.Generator(theirs(key, 0))
        for run in range(3):
            now = slice(run * EACH, (run + 1) * EACH)
            for expected in ([dice.uniform() for _ in range(EACH)], rng.random(EACH)):
                assert_array_equal(uniform[now], expected)
            exponentials = [dice.exponential() for _ in range(EACH)]
            for expected in (exponentials, -np.log1p(-rng.random(EACH))):
                assert_allclose(exponential[now], expected, rtol=1e-14)
            # Box and Muller: two uniform numbers give two normal numbers.
            lengths, turns = rng.random((EACH // 2, 2)).T
            lengths = np.sqrt(-2.0 * np.log1p(-lengths))
            angles = 2.0 * np.pi * turns
            pairs = np.stack([lengths * np.cos(angles), lengths * np.sin(angles)], 1)
            for expected in ([dice.normal() for _ in range(EACH)], pairs.ravel()):
                assert_allclose(normal[now], expected, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_similar_keys_and_the_two_streams_of_a_key_give_uncorrelated_numbers():
    """Compare keys that differ in one bit; bound all correlations with 99.9 % confidence."""
    base = np.uint64(0x0123456789ABCDEF)
    keys = np.append(base, base ^ _BITS)
    first, *others = stats.norm.ppf(drawn(keys, 2500)[0])
    bound = stats.norm.isf(0.0005 / len(others))
    for other in others:
        assert abs((first * other).mean()) * np.sqrt(first.size) < bound
    other = stats.norm.ppf(np.random.Generator(theirs(base, 1)).random(20_000))
    assert abs((first[:20_000] * other).mean()) * np.sqrt(other.size) < bound
