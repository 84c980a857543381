"""Tests of a survey with errors: filters work with wrong anchors and angles, the world does not."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binomtest

from mmwave_env.env import MmWaveLocEnv
from mmwave_env.models.random_scene import RandomSurvey
from mmwave_env.world.keys import keys_of
from tests.filters.tracks import (
    around_a_block,
    assert_same_fields,
    replay,
    sampled,
    street_source,
    wrapped,
)
from tests.refusals import refuses

NONE = dict.fromkeys(["rotation_rad", "tilt_rad", "range_m", "anchors_m", "heights_m", "slow"], 0.0)
KEYS = keys_of(range(400))


def pair(scenario="mixed", **sizes):
    """Return episodes of the same keys with an exact survey, and with these certain errors."""
    survey = RandomSurvey(**(NONE | {"rate": 1.0} | sizes))
    arguments = {"scenario": scenario, "radio": "standard", "epochs": 40}
    return [street_source(**arguments, survey=choice).episodes(KEYS) for choice in (None, survey)]


def changes(right, wrong):
    """Return what an inexact survey adds to ranges, azimuths, elevations, departures (T, L, 4)."""
    step = wrong.measurement - right.measurement
    links = np.where(right.visible[:, :3, None], step[:, :12].reshape(-1, 3, 4), np.nan)
    links[..., 1:] = wrapped(links[..., 1:])
    return links


@pytest.mark.parametrize(
    ("sizes", "rows"),
    [
        ({"rotation_rad": 0.05}, [0.0, 0.05, 0.0, 0.05]),
        ({"tilt_rad": 0.03}, [0.0, 0.0, 0.03, 0.0]),
        ({"range_m": 2.0}, [2.0, 0.0, 0.0, 0.0]),
    ],
    ids=["rotation", "tilt", "range"],
)
def test_all_links_of_an_episode_share_an_error_of_the_stated_size(sizes, rows):
    drawn = []
    for right, wrong in zip(*pair(**sizes), strict=True):
        change = changes(right, wrong)
        common = np.nanmedian(change, axis=(0, 1))
        known = np.isfinite(change)
        assert_allclose(change[known], np.broadcast_to(common, change.shape)[known], atol=1e-9)
        drawn.append(common)
        fields = ("truth_position_m", "visible", "snr_db", "prior_mean", "scene_anchors_m")
        assert_same_fields(wrong, right, *fields)
    spread = np.std(drawn, axis=0)
    assert_allclose(spread, rows, rtol=0.15)  # 4 standard deviations of 400 draws
    azimuth = np.array(drawn)[:, 1]
    assert_allclose(np.array(drawn)[:, 3], azimuth, atol=1e-9)


def test_filters_get_a_map_on_which_each_anchor_is_elsewhere_and_the_world_does_not():
    exact, wrong = pair(anchors_m=0.5, heights_m=2.0)
    away = np.array(
        [w.scene_anchors_m - e.scene_anchors_m for e, w in zip(exact, wrong, strict=True)]
    )
    assert_allclose(away.std(axis=0)[:, :2], 0.5, rtol=0.15)
    assert_allclose(away[:, :, 2], away[:, :1, 2] + np.zeros((1, 3)))
    assert away[:, 0, 2].std() == pytest.approx(2.0, rel=0.15)
    for right, other in zip(exact, wrong, strict=True):
        assert_array_equal(other.measurement, right.measurement)
        assert_array_equal(other.truth_position_m, right.truth_position_m)


def test_slow_errors_are_correlated_in_time_and_have_the_stated_size():
    exact, wrong = pair(slow=1.5)
    rows = [3, 1, 2]
    noise = np.array([
        (changes(e, w) / e.sigma[:, :12].reshape(-1, 3, 4))[..., rows]
        for e, w in zip(exact, wrong, strict=True)
    ])  # fmt: skip
    assert np.nanstd(noise) == pytest.approx(1.5, rel=0.05)
    after = noise[:, 10:]
    before = noise[:, :-10]
    both = np.isfinite(after) & np.isfinite(before)
    assert np.corrcoef(after[both], before[both])[0, 1] == pytest.approx(np.exp(-1 / 3), abs=0.05)


def test_an_episode_has_each_kind_of_error_at_its_rate():
    survey = replace(RandomSurvey(), rate=0.3)
    exact = street_source(radio="standard", epochs=4).episodes(KEYS)
    wrong = street_source(radio="standard", epochs=4, survey=survey).episodes(KEYS)
    moved = [not np.array_equal(e.scene_anchors_m[:, 2], w.scene_anchors_m[:, 2])
             for e, w in zip(exact, wrong, strict=True)]  # fmt: skip
    assert binomtest(sum(moved), len(moved), 0.3).pvalue > 1e-4


def test_observations_depend_on_the_map_and_the_measurements_but_not_on_the_truth():
    """Compare observations with those of a user who is elsewhere, with the same measurements."""
    source = street_source(radio="standard", epochs=21, survey=RandomSurvey(rate=1.0))
    for seed in range(3):
        episode = sampled(source, seed)
        elsewhere = replace(episode, truth_position_m=episode.truth_position_m + 30.0)
        there, here = (MmWaveLocEnv(episodes=replay(e)) for e in (elsewhere, episode))
        assert_array_equal(there.reset(seed=0)[0], here.reset(seed=0)[0])
        for _ in range(20):
            a, b = there.step(1), here.step(1)
            assert_array_equal(a[0], b[0])
            assert a[1] < b[1]


def test_users_on_given_ways_have_survey_errors_too():
    right, wrong = (episodes[0] for episodes in pair(around_a_block(), range_m=2.0))
    common = np.nanmedian(changes(right, wrong)[..., 0])
    assert abs(common) > 0.01
    assert_array_equal(right.truth_position_m, wrong.truth_position_m)


def test_wrong_surveys_are_refused():
    for survey in ("awful", 3):
        with refuses("survey"):
            MmWaveLocEnv(survey=survey)
    with refuses("survey"):
        MmWaveLocEnv(survey="bad", episodes="canyon28_vehicle")
    with refuses("rate"):
        RandomSurvey(rate=1.5)
