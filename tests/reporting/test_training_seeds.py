"""Tests of the results of a run (one policy per training seed): differences and intervals."""

import numpy as np
import pytest

from experiments.evaluation.intervals import Interval, bootstrap
from experiments.reporting.comparison_results import over_training_seeds

RUN = "runs/a"
OTHER = "runs/b"
EPISODES = 40


def rewards(seed, *shape):
    return np.random.default_rng(seed).normal(size=(*shape, EPISODES))


@pytest.fixture(scope="module")
def scores():
    names = ("fixed-ekf", "fixed-ukf", "speed-rule", "ppo", "imm", "imm-best")
    table = {name: {"reward": rewards(i)} for i, name in enumerate(names)}
    table["fixed-ukf"]["reward"] += 2.0
    table["imm-best"]["reward"] += 5.0
    return table


@pytest.fixture(scope="module")
def trained():
    """Return rewards (seeds, episodes) of two runs, of which the second is better."""
    return {RUN: rewards(10, 3), OTHER: rewards(11, 4) + 9.0}


@pytest.fixture(scope="module")
def compared(scores, trained):
    return {
        name: over_training_seeds(name, [{"reward": each} for each in rewards], scores)[0]
        for name, rewards in trained.items()
    }


def test_differences_are_paired_by_episode(compared, scores, trained):
    for name, content in compared.items():
        gains = [f"minus {rival}" for rival in ("fixed-ukf", "speed-rule", "imm", "imm-best")]
        assert list(content) == ["reward", *gains]
        for gain in gains:
            differences = trained[name] - scores[gain.removeprefix("minus ")]["reward"]
            assert content[gain]["above_zero"] == sum(i.low > 0.0 for i in bootstrap(differences))
            mean = Interval.of(content[gain]["mean"])
            assert mean.mean == pytest.approx(differences.mean())
            assert mean.low < mean.mean < mean.high
    assert [content["minus imm-best"]["above_zero"] for content in compared.values()] == [0, 4]


def test_a_run_without_rivals_still_has_its_reward(trained):
    rewards = [{"reward": reward} for reward in trained[RUN]]
    alone, table = over_training_seeds(RUN, rewards, {RUN: rewards[1]})
    assert [*alone] == ["reward"]
    assert alone["reward"]["mean"]["mean"] == pytest.approx(trained[RUN].mean())
    assert "| mean over seeds | " in table
