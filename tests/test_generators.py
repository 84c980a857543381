"""Random states that draw what numpy's generators draw."""

import numpy as np
import pytest
from gymnasium.utils import seeding

from mmwave_env.generators import Generators


def draws(generator):
    """Some of everything; an odd number of 32-bit draws leaves half a word behind."""
    return [
        generator.random(3).tolist(),
        generator.standard_normal(2).tolist(),
        generator.integers(9, size=1, dtype=np.int32).tolist(),
    ]


def test_they_go_on_where_they_were():
    ours, theirs = Generators(3), [seeding.np_random(seed)[0] for seed in (5, 6, 7)]
    for place in range(3):
        ours.seed(place, 5 + place)
    for places in ([0, 1, 2], [2], [1, 0], [2, 0]):
        with ours.of(places) as generators:
            found = [draws(generator) for generator in generators]
        assert found == [draws(theirs[place]) for place in places]
    assert [draws(copy) for copy in ours.copies()] == [draws(generator) for generator in theirs]
    assert ours.seeds() == (5, 6, 7)


def test_copies_change_nothing():
    ours = Generators(1)
    ours.seed(0, 1)
    assert draws(ours.copies()[0]) == draws(ours.copies()[0])


def test_without_a_seed_everyone_has_an_own():
    ours = Generators(2)
    with ours.of([0, 1]) as (a, b):
        assert a.random() != b.random()
    assert len({*ours.seeds(), *Generators(2).seeds()}) == 4


def test_what_was_drawn_before_an_error_is_drawn():
    ours, theirs = Generators(1), seeding.np_random(3)[0]
    ours.seed(0, 3)

    def draw_and_fail():
        with ours.of([0]) as (generator,):
            draws(generator)
            raise ValueError("stop")

    with pytest.raises(ValueError, match="stop"):
        draw_and_fail()
    draws(theirs)
    assert draws(ours.copies()[0]) == draws(theirs)
