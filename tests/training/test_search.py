"""Tests of the search for the best bank (the modes of an IMM and their transition matrix)."""

from dataclasses import fields

import numpy as np
import pytest

from experiments.training.tuning import START, best_bank_of, search_space
from mmwave_env.filters.bank import best_bank
from mmwave_env.filters.imm import stay_matrix
from mmwave_env.models.radio import TUNED_RADIOS


def distance(bank, planted):
    """Return the sum of squared differences between the logarithms of two banks' parameters."""
    pairs = [(np.array(bank.transition), np.array(planted.transition))]
    for field in ("sigma_p", "sigma_v", "acceleration_mps2"):
        values = [[getattr(mode, field) for mode in bank_of.modes] for bank_of in (bank, planted)]
        pairs.append((np.abs(values[0]) + 1e-3, np.abs(values[1]) + 1e-3))
    return float(sum(np.square(np.log(a / b)).sum() for a, b in pairs))


@pytest.mark.slow
def test_the_search_finds_a_planted_bank():
    """Score each bank by its closeness to a random bank, which is planted near the start."""
    space = search_space(START[:3])
    away = np.random.default_rng(0).standard_normal(len(space.start))
    planted = space.bank_at(space.start + 0.7 * space.deviation * away)
    start = best_bank_of(space, lambda bank, _: -distance(bank, planted), 0)
    best = best_bank_of(space, lambda bank, _: -distance(bank, planted), 3000)
    assert distance(best, planted) < 0.02 * distance(start, planted)


def test_generations_are_numbered_and_the_number_of_evaluations_is_limited():
    asked = []

    def value(bank, generation):
        asked.append(generation)
        return 0.0

    best_bank_of(search_space(START[1:3]), value, 40)
    size = asked.count(0)
    assert asked == [i // size for i in range(len(asked))]
    assert 40 - size < len(asked) <= 40


def test_the_search_starts_from_the_modes_and_varies_every_parameter():
    space = search_space(START)
    n = len(START)
    start = space.bank_at(space.start)
    assert start.modes == START and start.nis_quantile == 0.999
    np.testing.assert_allclose(start.transition, stay_matrix(n), atol=1e-5)
    maneuvers = sum(bool(mode.acceleration_mps2) for mode in START)
    assert len(space.start) == n * (n - 1) + 2 * n + maneuvers + 1
    for i, deviation in enumerate(space.deviation):
        moved = space.start.copy()
        moved[i] += deviation
        assert space.bank_at(moved) != start


@pytest.mark.parametrize("radio", TUNED_RADIOS)
def test_shipped_banks_differ_from_the_start_only_in_searched_parameters(radio):
    for before, after in zip(START, best_bank(radio).modes, strict=True):
        free = {"sigma_p", "sigma_v", "acceleration_mps2"}
        fixed = {f.name: getattr(before, f.name) for f in fields(before) if f.name not in free}
        assert fixed == {name: getattr(after, name) for name in fixed}
