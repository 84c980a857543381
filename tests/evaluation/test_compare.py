"""Tests of comparing a user's own agents with known contenders."""

import numpy as np
import pytest

from experiments.console.options import EpisodeArgs
from experiments.evaluation.compare import compare
from experiments.reporting.comparison_results import results
from mmwave_env.metrics import METRICS
from tests.refusals import refuses
from tests.training.actors import HANDSET


def test_an_agent_that_always_chooses_the_second_mode_scores_as_fixed_ukf_does():
    observed = []

    def act(observations):
        observed.append(observations)
        return np.ones(len(observations), int)

    comparison = compare({"mine": act}, beside=("fixed-ukf", "imm"), episodes=3, seed=4)
    assert (comparison.scenario, *comparison.selection.seeds) == ("mixed", 4, 5, 6)
    assert list(comparison.policies) == ["mine", "fixed-ukf", "imm"]
    assert comparison.policies["mine"] == comparison.policies["fixed-ukf"]
    for metric in METRICS:
        nothing = comparison.paired["mine - fixed-ukf"][metric]
        assert (nothing.mean, nothing.low, nothing.high) == (0.0, 0.0, 0.0)
    assert all(o.shape == observed[0].shape and o.dtype == np.float32 for o in observed)
    assert len(observed) == 201 and len(observed[0]) == 3  # 200 steps and a trial call
    assert "| mine | -" in str(comparison) and "minus fixed-ukf" in str(comparison)


def test_known_contenders_are_paired_as_the_command_pairs_them():
    def act(observations):
        return np.ones(len(observations), int)

    beside = ("guided", "imm-best", "speed-rule")
    comparison = compare({"mine": act}, beside, episodes=1, episode_steps=20)
    _, _, by_command, _ = results(EpisodeArgs(episodes=1, episode_steps=20), beside)
    mine = {f"mine - {other}" for other in beside}
    assert set(comparison.paired) == {*by_command["paired"], *mine}


@pytest.mark.parametrize(
    "act",
    [lambda o: np.ones((len(o), 1), int), lambda o: (np.ones(len(o), int), None), np.ones(3)],
)
def test_invalid_actions_are_refused(act):
    with pytest.raises(ValueError, match="mine.*model.predict"):
        compare({"mine": act}, beside=(), episodes=2)


def test_other_mistakes_are_named():
    with refuses("policy"):
        compare({}, beside=("oracle",))
    with refuses("policies"):
        compare({"imm": np.zeros_like}, beside=("imm",))
    with refuses("scenario"):
        compare({}, scenario="train")
    with refuses("policies"):
        compare(len)
    with refuses("modes"):
        compare({"mine": np.zeros_like}, modes=HANDSET)
    with refuses("episodes"):
        compare({}, episodes="ride")


def test_the_imm_by_name_uses_the_bank_and_its_transition():
    def none(observations):
        return np.zeros(len(observations), int)

    none.beliefs, none.modes = "per-mode", HANDSET
    comparison = compare({"none": none, "over it": "imm"}, (), episodes=2, modes=HANDSET)
    for metric in METRICS:
        assert abs(comparison.paired["none - over it"][metric].mean) < 1e-9


@pytest.mark.slow
def test_compare_accepts_the_arguments_of_the_environment():
    def act(observations):
        return np.ones(len(observations), int)

    where = {"data": "canyon28_vehicle", "episode_steps": 30, "planar": True, "reward": "log-score"}
    comparison = compare({"mine": act}, beside=("fixed-ukf",), episodes=2, **where)
    assert comparison.scenario == "canyon28_vehicle"
    assert comparison.policies["mine"] == comparison.policies["fixed-ukf"]
    assert str(comparison).splitlines()[0].endswith(", seeds 0 and up, reward log-score")
    with refuses("reward"):
        compare({"mine": act}, reward="paired")
    with pytest.raises(TypeError, match="'odometer', expected one of .*odometry"):
        compare({"mine": act}, odometer=True)
