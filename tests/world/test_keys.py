"""Tests of keys (64-bit seeds of episodes) and of streams (sequences of keys)."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import mmwave_env  # noqa: F401  registers the environment
from experiments.evaluation.contenders import keys_for
from mmwave_env.world.keys import Streams, key_from, keys_at, keys_of, stream_of
from tests.environment.vector_checker import same
from tests.refusals import refuses

SHORT = {"episode_steps": 2, "modes": ["ekf"]}
make = partial(gym.make, "MmWaveLoc-v0", **SHORT)


def numbers(*values):
    return np.array(values, np.uint64)


def test_keys_are_the_published_numbers_of_splitmix64():
    """Compare with the numbers of Vigna's C code, as Rosetta Code lists them for state 1234567."""
    keys = keys_at(numbers(1234567), np.arange(3, dtype=np.uint64))
    assert keys.tolist() == [6457827717110365317, 3203168211198807973, 9817491932198370423]


def test_the_end_of_a_stream_is_followed_by_its_beginning():
    last = keys_at(numbers(5), numbers(2**64 - 1))
    # SplitMix64 adds this constant for each key, so subtracting it begins a stream one key earlier.
    assert last == keys_at(numbers(5 - 0x9E3779B97F4A7C15 + 2**64), numbers(0))


def test_the_stream_of_a_seed_begins_with_numpys_seed_sequence():
    assert stream_of(0) == np.random.SeedSequence(0).generate_state(1, np.uint64)[0]
    assert len(set(keys_of(range(2000)).tolist())) == 2000


def test_a_stream_without_a_seed_begins_at_random():
    streams = Streams(2)
    places = np.arange(2)
    assert streams.seeds == [-1, -1]  # unknown seeds
    keys = streams.keys(places)
    assert keys[0] != keys[1] != Streams(2).keys(places)[1]


def test_a_seed_gives_the_same_keys_everywhere():
    """Compare a single environment, our vector environment, and evaluation."""
    single = make()
    native = gym.make_vec("MmWaveLoc-v0", num_envs=2, autoreset_mode="Disabled", **SHORT)
    expected = keys_at(stream_of(8), np.arange(3, dtype=np.uint64)).tolist()
    for seed in (8, None, None):
        keys = [
            single.reset(seed=seed)[1]["episode_key"],
            native.reset(seed=seed)[1]["episode_key"][0],
        ]
        assert keys == [expected.pop(0)] * 2
    keys = keys_for(single.unwrapped.source, range(8, 10)).tolist()
    assert keys == native.reset(seed=8)[1]["episode_key"].tolist()


def test_a_custom_random_generator_begins_a_stream():
    env = make().unwrapped
    keys = []
    for _ in range(2):
        env.np_random = np.random.default_rng(3)
        keys.append([env.reset()[1]["episode_key"] for _ in range(3)])
    assert keys[0] == keys[1] and len(set(keys[0])) == 3
    assert env.reset(seed=2)[1]["episode_key"] == keys_of([2])[0]


@pytest.mark.parametrize("key", [-1, 2**64, 0.0, "1", None, True, np.array([1, 2])])
def test_a_key_that_is_not_an_integer_of_64_bits_is_refused(key):
    with refuses("episode_key"):
        key_from(key)


def test_a_key_plays_its_episode_again_and_does_not_advance_the_stream():
    env = make()
    observation, info = env.reset(seed=3)
    played = info["episode_key"]
    for key in (played, int(played)):
        again, same_info = env.reset(options={"episode_key": key})
        assert_array_equal(again, observation)
        assert same(same_info, info)
    assert played.dtype == np.uint64
    vector = gym.make_vec("MmWaveLoc-v0", num_envs=3, **SHORT)
    several, infos = vector.reset(options={"episode_key": [5, played, 6]})
    assert_array_equal(several[1], observation)
    assert infos["episode_key"].tolist() == [5, int(played), 6]
    single = env.step(0)
    many = vector.step(np.zeros(3, int))
    assert_array_equal(many[0][1], single[0])
    assert many[1][1] == single[1]
    assert env.reset()[1]["episode_key"] == keys_at(stream_of(3), numbers(1))[0]


def test_a_key_together_with_a_seed_or_a_recording_is_refused():
    with refuses("episode_key", "seed"):
        make().reset(seed=3, options={"episode_key": 1})
    env = make(episodes="canyon28_vehicle")
    with refuses("episode_key"):
        env.reset(options={"episode_key": 1})
    assert "episode_key" not in env.reset(seed=0)[1]
