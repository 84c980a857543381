"""Tests of the simplest policies: the speed rule, the likelihood rule and fixed modes."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from experiments.console.options import TUNING_SEED
from experiments.evaluation.contenders import contender_from, draw_episodes
from experiments.evaluation.runner import score
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import modes_from
from mmwave_env.interface.observation import Observation
from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import TUNED_RADIOS
from mmwave_env.world.episode import blank_incoming
from policies import LikelihoodRule, SpeedRule
from policies.rules import by_odometry_speed, by_predicted_speed
from tests.filters.tracks import street_source

THREE = ("ekf", "ukf", "ckf")


@pytest.fixture(scope="module")
def table():
    return Observation(Pipeline(modes_from(THREE), Layout(odometry=True)))


def observe(table, **features):
    """Return observations (n, features) with the values in ``features`` and means elsewhere."""
    columns = {name.replace("_", " "): np.atleast_1d(v) for name, v in features.items()}
    n = max(len(column) for column in columns.values())
    observation = np.zeros((n, len(table)))
    for name, values in columns.items():
        i = table.names.index(name)
        feature = table.features[i]
        mean = feature.mean
        deviation = feature.deviation
        observation[:, i] = (np.clip(values, feature.low, feature.high) - mean) / deviation
    return observation.astype(np.float32)


@pytest.mark.parametrize(("arguments", "threshold"), [([0.0], 0.0), ([], 2.0), ([7.3], 7.3)])
def test_the_speed_rule_switches_above_its_threshold_or_that_of_the_paper(
    table, arguments, threshold
):
    speeds = [0.0, threshold * (1.0 - 1e-6), threshold, threshold * (1.0 + 1e-6) + 1e-6, 19.9]
    actions = SpeedRule(table, *arguments).act(observe(table, predicted_speed=speeds))
    assert_array_equal(actions, [0, 0, 0, 1, 1])


def test_the_speed_rule_warns_once_above_its_range_of_speeds_but_chooses_the_fast_mode(table):
    rule = SpeedRule(table)
    fast = observe(table, predicted_speed=[1.0, 20.5, 35.0])
    rule.act(observe(table, predicted_speed=[19.99]))  # must not warn: a warning fails the test
    with pytest.warns(UserWarning, match="20 m/s") as caught:
        assert_array_equal(rule.act(fast), [0, 1, 1])
    assert len(caught) == 1
    assert_array_equal(rule.act(fast), [0, 1, 1])


def test_the_likelihood_rule_chooses_the_mode_with_the_highest_preference(table):
    # Preferences are relative to the last mode (ckf), whose own preference is 0.
    scores = np.random.default_rng(0).normal(0.0, 5.0, (100, 2))
    features = {"preference_fast_ekf": scores[:, 0], "preference_fast_ukf": scores[:, 1]}
    actions = LikelihoodRule(table, list(THREE)).act(observe(table, **features))
    expected = np.column_stack([scores, np.zeros(100)]).argmax(axis=1)
    assert_array_equal(actions, expected)
    assert set(actions) == {0, 1, 2}


def test_the_likelihood_rule_needs_features_of_the_coming_epoch():
    prior = Observation(Pipeline(modes_from(None), Layout()), "prior")
    with pytest.raises(ValueError, match="preference fast ekf"):
        LikelihoodRule(prior, ["ekf", "ukf"]).act(np.zeros((1, len(prior)), np.float32))


@pytest.mark.parametrize(("speed", "mode"), [(0.0, 0), (2.0, 0), (2.001, 1), (20.0, 1), (99.0, 1)])
def test_the_speed_rules_for_single_tracks_switch_at_the_threshold_of_the_paper(speed, mode):
    x = [0.0, 0.0, 0.0, 0.6 * speed, -0.8 * speed, 0.0, 7.0]
    layout = Layout(3, odometry=True)
    blank = blank_incoming(layout).epoch(layout)  # nothing is measured
    assert by_predicted_speed(x, blank) == by_odometry_speed(x, blank) == mode
    assert by_predicted_speed([0.0, 0.0, 0.0, 0.0, 0.0, speed, 0.0], blank) == mode
    measured = blank._replace(z=[*blank.z[:-2], speed, 3.0], visible=[*blank.visible[:-1], 1.0])
    assert by_odometry_speed([0.0] * 7, measured) == mode
    assert by_odometry_speed([99.0] * 7, measured) == mode


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:speed .* is outside the design window")
@pytest.mark.parametrize("radio", TUNED_RADIOS)
def test_no_threshold_of_the_speed_rule_beats_zero(radio):
    """Compare thresholds (m/s) on tuning seeds; with zero, the rule acts like `fixed-ukf`."""
    source = street_source(radio=radio)
    episodes = draw_episodes(source, range(TUNING_SEED, TUNING_SEED + 500))
    rule = contender_from("speed-rule", radio)
    rewards = {}
    for mps in (0.0, 0.25, 0.5, 1.0, 2.0, 3.0):
        moved = replace(rule, policy=partial(SpeedRule, threshold=mps))
        rewards[mps] = score(moved, episodes)["reward"].mean()
    assert max(rewards, key=rewards.get) == 0.0
