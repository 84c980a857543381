"""Tests of comparing a user's own agents with known contenders."""

import numpy as np
import pytest

from experiments.evaluation.compare import compare
from tests.refusals import refuses
from tests.training.actors import HANDSET


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
    with refuses("reward"):
        compare({"mine": np.zeros_like}, reward="paired")
    with pytest.raises(TypeError, match="'odometer', expected one of .*odometry"):
        compare({}, odometer=True)
