"""Trainings with the defaults of other libraries: they run, and the arithmetic is the book's."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from experiments.learning.defaults import RIVALS, defaults, defaults_table  # noqa: E402
from experiments.learning.plain_ppo import DISCOUNT, LAMBDA, advantages_of  # noqa: E402

pytestmark = pytest.mark.torch


def test_advantages_are_sums_of_discounted_surprises_up_to_the_end_of_the_episode():
    rng = np.random.default_rng(0)
    T, n = 12, 3
    rewards, values, last = rng.normal(size=(T, n)), rng.normal(size=(T, n)), rng.normal(size=n)
    ends = rng.random((T, n)) < 0.2
    found = advantages_of(*map(torch.tensor, (rewards, values, ends.astype(float), last)))
    after = np.vstack([values[1:], last])
    surprise = rewards + DISCOUNT * after * ~ends - values
    for env in range(n):
        for t in range(T):
            expected, factor = 0.0, 1.0
            for later in range(t, T):
                expected += factor * surprise[later, env]
                if ends[later, env]:
                    break
                factor *= DISCOUNT * LAMBDA
            assert float(found[t, env]) == pytest.approx(expected)


@pytest.mark.slow
def test_every_library_trains_with_both_kinds_of_beliefs():
    record = defaults(steps=2048, seeds=2, episodes=20)
    assert [(row["library"], row["beliefs"]) for row in record["rows"]] == [
        (library, beliefs)
        for library in ("Stable-Baselines3", "CleanRL")
        for beliefs in ("shared", "per-mode")
    ]
    for row in record["rows"]:
        assert len(set(row["each"])) == 2  # other seeds, other agents
        for rival in RIVALS:
            low, high = row[f"minus {rival}"]["ci95"]
            assert low <= row[f"minus {rival}"]["mean"] <= high
    assert defaults_table(record).count("\n") == 5
