"""The evolution strategy over continuous trust: its start is the IMM, its points do not mix."""

import json

import numpy as np
import pytest

from experiments.learning import evolution
from experiments.learning.evolution import LinearTrust, evolved
from mmwave_env.filters.bank import best_bank
from mmwave_env.observation import Observation
from mmwave_env.task import task_from

BANK = best_bank()


def some_trust(points):
    count = len(LinearTrust(BANK, np.zeros((1, 1, 1))).features) + 1
    rng = np.random.default_rng(0)
    return LinearTrust(BANK, rng.normal(size=(points, count, len(BANK.modes) - 1)))


def observations(n):
    table = Observation(task_from(beliefs="per-mode").pipeline, beliefs="per-mode")
    return np.random.default_rng(1).normal(size=(n, len(table))).astype(np.float32)


def test_environments_are_shared_out_among_points():
    both, seen = some_trust(2), observations(6)
    each = [
        LinearTrust(BANK, weights[None])(seen[3 * i : 3 * i + 3])
        for i, weights in enumerate(both.weights)
    ]
    np.testing.assert_allclose(both(seen), np.concatenate(each))
    assert (both(seen)[:, 0] == 0.0).all()  # relative to the first mode


def test_without_weights_no_mode_is_trusted():
    trust = LinearTrust(BANK, np.zeros_like(some_trust(1).weights))
    assert not trust(observations(4)).any()


def test_what_a_file_holds_is_the_same_trust():
    trust = some_trust(1)
    read = LinearTrust.of(json.loads(json.dumps(trust.json)))
    np.testing.assert_array_equal(read(observations(4)), trust(observations(4)))
    assert read.bank == BANK and len(read.features) == trust.weights.shape[1] - 1


@pytest.mark.slow
def test_a_search_looks_at_tuning_episodes_and_keeps_the_best(monkeypatch):
    pytest.importorskip("cmaes")
    monkeypatch.setattr(evolution, "EPISODES", 8)
    monkeypatch.setattr(evolution, "TUNING_EPISODES", 8)
    source = task_from(beliefs="per-mode", episode_steps=12).source
    looks = []
    trust, figures = evolved(BANK, source, 2, lambda *look: looks.append(look))
    assert [generation for generation, _ in looks] == [1, 2]
    best = max(0.0, *(gain for _, gain in looks))  # none of them beats the IMM: the start
    assert figures["tuning"]["minus its own IMM"]["mean"] == pytest.approx(best)
    assert figures["tuning"]["seed"] == 5_000_000
    assert trust.weights.any() == (best > 0.0)
