"""Keys of episodes, and the bare generators that draw them."""

import numpy as np
import pytest
from gymnasium.utils import seeding

from mmwave_env.episodes.keys import Generators, draw_key, key_from, next_words


def test_bare_generators_draw_what_numpys_do():
    generators, places = Generators(50), np.arange(50)
    for place in places:
        generators.seed(place, 3 * int(place))
    whole = [seeding.np_random(3 * int(place))[0] for place in places]
    for _ in range(20):
        assert generators.keys(places).tolist() == [draw_key(rng) for rng in whole]
    some = np.array([7, 3])
    assert generators.keys(some).tolist() == [draw_key(whole[place]) for place in some]
    assert [a.random() for a in generators.copies()] == [b.random() for b in whole]


def test_words_carry_over_from_the_low_half_to_the_high_one():
    edge = 2**64 - 1
    states = np.array([[0, edge, 0, 1], [edge] * 4, [1, 0, 0, 1], [0, 2**32, 5, edge]], np.uint64)
    whole = []
    for state_high, state_low, step_high, step_low in states.tolist():
        rng = np.random.Generator(np.random.PCG64(0))
        state = rng.bit_generator.state
        state["state"] = {
            "state": (state_high << 64) | state_low, "inc": (step_high << 64) | step_low
        }  # fmt: skip
        rng.bit_generator.state = state
        whole.append(rng.bit_generator)
    for _ in range(5):
        assert next_words(states).tolist() == [bits.random_raw() for bits in whole]


def test_states_go_on_elsewhere():
    one, other, places = Generators(5), Generators(5), np.arange(5)
    one.keys(places)
    other.set_states(one.states())
    assert one.keys(places).tolist() == other.keys(places).tolist()


def test_whole_generators_are_kept_where_a_source_asks_for_them():
    generators = Generators(2, bare=False)
    generators.seed(1, 4)
    assert generators.whole(1).random() == seeding.np_random(4)[0].random()
    assert len(generators.copies()) == 2 and generators.seeds()[1] == 4


@pytest.mark.parametrize("key", [0, 7, np.int32(5), np.uint64(2**64 - 1), 2**64 - 1])
def test_an_integer_of_64_bits_is_a_key(key):
    assert key_from(key) == int(key)


@pytest.mark.parametrize("key", [-1, 2**64, 0.0, "1", None, True, np.array([1, 2])])
def test_anything_else_is_refused(key):
    with pytest.raises(ValueError, match=r"episode_key: found .*, expected an integer from 0 to 2"):
        key_from(key)
