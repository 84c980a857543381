"""Tests of results over the training seeds of a run: paired differences and their intervals."""

import numpy as np
import pytest

from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runs import Run
from experiments.evaluation.training_seeds import over_training_seeds, seeds_markdown

RUN = Run("runs/a", (2, 0, 1), 0)
OTHER = Run("runs/b", (0, 1, 2, 3), 3)
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
    """Return rewards (trainings, episodes) of two runs, of which the second is better."""
    return {RUN: rewards(10, 3), OTHER: rewards(11, 4) + 9.0}


@pytest.fixture(scope="module")
def compared(scores, trained):
    return over_training_seeds(
        {run: [{"reward": each} for each in rewards] for run, rewards in trained.items()}, scores
    )


def test_differences_are_paired_by_episode(compared, scores, trained):
    for seeds in compared:
        for rival, figure in seeds.minus.items():
            differences = trained[seeds.run] - scores[rival]["reward"]
            assert list(figure.each) == bootstrap(differences.T)
            assert figure.wins == sum(i.low > 0.0 for i in bootstrap(differences.T))
            assert figure.mean.mean == pytest.approx(differences.mean())
            assert figure.mean.low < figure.mean.mean < figure.mean.high
    assert compared[0].minus["imm-best"].wins == 0 and compared[1].minus["imm-best"].wins == 4


def test_a_run_without_rivals_still_has_its_reward(trained):
    run = {RUN: [{"reward": reward} for reward in trained[RUN]]}
    (alone,) = over_training_seeds(run, {"runs/a": {"reward": trained[RUN][1]}})
    assert alone.minus == {} and alone.best_imm is None
    assert alone.reward.mean.mean == pytest.approx(trained[RUN].mean())
    assert "| mean over seeds | " in seeds_markdown(alone)
