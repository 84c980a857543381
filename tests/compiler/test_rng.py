"""Random states that draw what numpy's generators draw."""

import numba
import numpy as np
import pytest
from gymnasium.utils import seeding

from mmwave_env.compiler import rng as generators
from mmwave_env.compiler.rng import Generators, load_state, rng_view, save_state, whole_rng


def draws(generator):
    """Some of everything; an odd number of 32-bit draws leaves half a word behind."""
    return [
        generator.random(3).tolist(),
        generator.standard_normal(2).tolist(),
        generator.integers(9, size=1, dtype=np.int32).tolist(),
    ]


def test_whole_ones_go_on_where_they_were():
    ours, theirs = Generators(3, small=False), [seeding.np_random(seed)[0] for seed in (5, 6, 7)]
    for place in range(3):
        ours.seed(place, 5 + place)
    for place in (0, 1, 2, 2, 1, 0):
        assert draws(ours.whole(place)) == draws(theirs[place])
    copies = ours.copies()
    assert [draws(copy) for copy in copies] == [draws(generator) for generator in theirs]
    assert draws(ours.whole(0)) != draws(copies[0])
    assert ours.seeds() == (5, 6, 7)


@pytest.mark.parametrize("small", [False, True])
def test_copies_change_nothing(small):
    ours = Generators(1, small)
    ours.seed(0, 1)
    assert draws(ours.copies()[0]) == draws(ours.copies()[0])


@pytest.mark.parametrize("small", [False, True])
def test_without_a_seed_everyone_has_an_own(small):
    ours = Generators(2, small)
    a, b = ours.copies()
    assert a.random() != b.random()
    assert len({*ours.seeds(), *Generators(2, small).seeds()}) == 4


def test_bare_states_are_copies_that_go_on_elsewhere():
    ours, other = Generators(3), Generators(3)
    ours.seed(1, 5)  # the others get seeds of their own
    other.seed(0, 6)
    bare = ours.bare()
    other.set_bare(bare)
    expected = [draws(copy) for copy in ours.copies()]
    assert [draws(copy) for copy in other.copies()] == expected
    assert other.seeds() == (-1, -1, -1) and ours.seeds()[1] == 5
    bare[:] = 0
    assert [draws(copy) for copy in ours.copies()] == expected
    assert [draws(copy) for copy in other.copies()] == expected


@numba.njit
def compiled_draws(view, out):
    for i in (2, 0, 1, 2):  # in any order, and more than once
        load_state(view, i)
        out[i, 0] = view[0].random()
        out[i, 1] = view[0].standard_normal()
        out[i, 2] = view[0].standard_exponential()
        save_state(view, i)


def drawn(generator):
    return [generator.random(), generator.standard_normal(), generator.standard_exponential()]


def test_compiled_code_draws_what_generators_draw():
    ours, out = Generators(4), np.zeros((3, 3))
    for place in range(4):
        ours.seed(place, place)
    theirs = ours.copies()
    places = np.array([3, 0, 1])
    with ours.states(places) as states:
        compiled_draws(rng_view(states), out)
    drawn(theirs[1])
    np.testing.assert_array_equal(out, [drawn(theirs[place]) for place in places])
    assert [draws(copy) for copy in ours.copies()] == [draws(generator) for generator in theirs]


@pytest.mark.parametrize("kind", [np.random.PCG64, np.random.MT19937, np.random.Philox])
def test_compiled_code_draws_from_a_generator_of_any_kind(kind):
    ours, theirs = np.random.Generator(kind(5)), np.random.Generator(kind(5))
    first, second = np.zeros((1, 3)), np.zeros((1, 3))
    one_draw(whole_rng(ours), first)
    one_draw(whole_rng(ours), second)
    np.testing.assert_array_equal([*first, *second], [drawn(theirs), drawn(theirs)])


@numba.njit
def one_draw(view, out):
    load_state(view, 0)
    out[0, 0] = view[0].random()
    out[0, 1] = view[0].standard_normal()
    out[0, 2] = view[0].standard_exponential()
    save_state(view, 0)


def test_a_numpy_that_keeps_states_elsewhere_is_refused(monkeypatch):
    elsewhere = np.zeros(4, np.uint64)
    monkeypatch.setattr(generators, "_memory", lambda rng: elsewhere)
    with pytest.raises(RuntimeError, match="numpy .*: found the state of a PCG64 elsewhere"):
        Generators(1)
