"""Tests of the beginnings of tracks: from any links, in spite of reflections, and after outages."""

from itertools import groupby

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.evaluation.contenders import contender_from
from mmwave_env.filters.bank import named_modes
from mmwave_env.localization.diagnosis import AS_IT_IS, diagnose
from mmwave_env.localization.localizer import localize
from mmwave_env.localization.readings import Reading
from mmwave_env.localization.segments import segments
from mmwave_env.localization.starts import start_at
from mmwave_env.localization.tracker import Tracker
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import scene_of_anchors
from tests.filters.tracks import nees_of
from tests.paths import representative

RADIO = RADIOS["standard"]
ONE = scene_of_anchors("one", np.array([[0.0, 0.0, 2.5]]), 60e9, 1.76e9)
FOUR = np.array([[0.0, 0.0, 2.5], [10.0, 0.0, 2.5], [10.0, 8.0, 2.0], [0.0, 8.0, 1.8]])
ROOM = scene_of_anchors("room", FOUR, 6.5e9, 5e8)
WIDE = scene_of_anchors(
    "wide", np.array([[10.0, 10.0, 10.0], [10.0, 60.0, 10.0], [160.0, 10.0, 10.0]]), 28e9, 1e8
)
RANGES = {"range_sigma_m": 0.1}
FAINT = {"range_sigma_m": 0.5}
BOTH = RANGES | {"aoa_azimuth_sigma_deg": 3.0}


def rows_of(scene, times, path, wrong=lambda t, link: link, seen=None, seed=0, noise=BOTH):
    """Return the rows (dicts) of a log with ranges and, perhaps, azimuths of arrival.

    Args:
        times: times of the epochs.
        path: function from time to position.
        wrong: function of time and a link [range, azimuth in degrees] to the link received.
        seen: function from the number of an epoch to the anchors that are measured.
        noise: standard deviations that the receiver states.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for number, t in enumerate(times):
        for anchor in range(len(scene.anchors_m)) if seen is None else seen(number):
            east, north, up = path(t) - scene.anchors_m[anchor]
            link = [np.hypot(np.hypot(east, north), up), np.degrees(np.arctan2(north, east))]
            distance, azimuth = wrong(t, link)
            row = {"time_s": float(t), "anchor": anchor + 1.0}
            row["range_m"] = float(distance + 0.1 * rng.standard_normal())
            if "aoa_azimuth_sigma_deg" in noise:
                azimuth += 3.0 * rng.standard_normal()
                row["aoa_azimuth_deg"] = float((azimuth + 180.0) % 360.0 - 180.0)
            rows.append(row | noise)
    return rows


def log_of(tmp_path, scene, rows, clock="synchronized"):
    path = tmp_path / "log.csv"
    pd.DataFrame(rows).to_csv(path, index=False)
    return read_log(path, scene, clock=clock)


def tracked(tmp_path, scene, rows, policy, **options):
    """Return the track of a log with these rows."""
    switching = contender_from(policy, "standard")
    return localize(log_of(tmp_path, scene, rows), scene, RADIO, switching, **options)


def places(t):
    """Return standing places that are 0.5 m apart."""
    return np.array([3.0 + 0.4 * t, 4.0 + 0.3 * t, 1.5])


def circle(t):
    return np.array([5.0 + 3.0 * np.cos(0.2 * t), 4.0 + 2.0 * np.sin(0.2 * t), 1.2])


def errors(track, path, means):
    """Return horizontal errors (T, 2)."""
    truth = np.array([path(t)[:2] for t in track.time_s])
    return means[:, :2] - truth


def rms(errors):
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def block(t):
    """Return a place on the way of a car around a block of 60 m, at 15 m/s."""
    side, passed = divmod(15.0 * t, 60.0)
    corners = np.array(
        [[40.0, 15.0, 1.5], [100.0, 15.0, 1.5], [100.0, 75.0, 1.5], [40.0, 75.0, 1.5]]
    )
    begin = corners[int(side) % 4]
    return begin + passed / 60.0 * (corners[(int(side) + 1) % 4] - begin)


TURNING = np.arange(0.0, 160.0, 2.0)
REFLECTED = {"the first two": (0, 1), "the second": (1,), "the third": (2,), "the tenth": (9,)}


@pytest.mark.parametrize("reflected", REFLECTED.values(), ids=REFLECTED)
@pytest.mark.parametrize("policy", ["imm-best", "speed-rule"])
def test_reflections_among_the_first_epochs_do_no_lasting_harm(tmp_path, reflected, policy):
    """Check 3 m too far and 30 degrees aside, on average over logs that differ in their noise."""
    means = {}
    for name, epochs in (("right", ()), ("reflected", reflected)):
        smoothed, filtered, squared = [], [], []
        for seed in range(6):

            def wrong(t, link, epochs=epochs):
                return [link[0] + 3.0, link[1] + 30.0] if t in epochs else link

            rows = rows_of(ONE, range(45), places, wrong, seed=seed)
            track = tracked(tmp_path, ONE, rows, policy)
            smooth = errors(track, places, track.smooth_x)
            smoothed.append(rms(smooth))
            filtered.append(rms(errors(track, places, track.x)[4:]))
            squared.append(nees_of(smooth, track.smooth_P).mean())
            first = nees_of(errors(track, places, track.x), track.P)[:4]
            assert len(track) == 45 and np.median(first) < 5.99  # inside their 95 %
        means[name] = np.mean([smoothed, filtered, squared], axis=1)
    assert (means["reflected"][:2] <= 1.15 * means["right"][:2]).all()
    assert means["reflected"][2] <= 4.0


def outage(t, link):
    return [link[0] + 10.0, link[1]] if 74 <= t < 80 else link


def street(t):
    return np.array([20.0 + 0.7 * t, 15.0, 1.5])


@pytest.mark.parametrize("policy", representative(["imm-best", "speed-rule"], "speed-rule"))
def test_ranges_that_are_wrong_after_an_outage_are_taken_back(tmp_path, policy):
    times = [*range(60), *range(74, 100)]
    rows = rows_of(ROOM, times, street, outage)
    track = tracked(tmp_path, ROOM, rows, policy, window=None)
    wrong = np.linalg.norm(errors(track, street, track.x), axis=1)
    assert wrong[track.time_s >= 84].max() < 2.0


@pytest.mark.parametrize("policy", ["imm-best", "corrector"])
def test_a_car_that_turns_between_two_epochs_is_found_again(tmp_path, policy):
    rows = rows_of(WIDE, TURNING, block, noise=BOTH | FAINT)
    track = tracked(tmp_path, WIDE, rows, policy)
    wrong = errors(track, block, track.x)
    smooth = errors(track, block, track.smooth_x)
    assert len(track) == len(TURNING) and nees_of(wrong, track.P).mean() < 8.0
    assert rms(wrong) < 8.0 and rms(smooth) < 8.0


def test_sequential_ranges_begin_a_track_within_two_seconds(tmp_path):
    """Check ranges that a receiver measures one after the other, 10 a second, with 0.1 m noise."""
    times = np.arange(0.0, 60.0, 0.1).round(1)
    rows = rows_of(ROOM, times, circle, seen=lambda n: [n % 4], noise=RANGES)
    track = tracked(tmp_path, ROOM, rows, "imm-best")
    assert track.time_s[0] <= 2.0
    late = track.time_s > 10.0
    assert rms(errors(track, circle, track.x)[late]) < 0.15
    assert rms(errors(track, circle, track.smooth_x)[late]) < 0.08


def stroll(t):
    return np.array([20.0 + 1.2 * t, 30.0 + 3.0 * np.sin(t / 9.0), 1.5])


def late_rms(tmp_path, rows):
    """Return the error of an EKF's track of a stroll, without the first 20 s."""
    track = tracked(tmp_path, WIDE, rows, "speed-rule")
    return rms(errors(track, stroll, track.x)[track.time_s > 20.0])


def test_an_ekf_survives_a_reflected_range_in_the_first_second(tmp_path):
    """Check ranges that are measured one after the other, the second one 8 m too long."""
    times = [second + later for second in range(60) for later in (0.0, 0.1, 0.2)]
    for seed in (0, 6, 7):
        rows = rows_of(WIDE, times, stroll, seen=lambda n: [n % 3], seed=seed, noise=FAINT)
        rows[1]["range_m"] += 8.0
        assert late_rms(tmp_path, rows) < 1.0


def test_an_ekf_survives_a_wrong_azimuth_in_the_first_epoch(tmp_path):
    """Check the azimuths of two anchors, one of which is 25 degrees aside at first."""
    for seed in (0, 3, 4):
        rows = rows_of(WIDE, range(60), stroll, seen=lambda n: [0, 1], seed=seed)
        for row in rows:
            del row["range_m"], row["range_sigma_m"]
        rows[0]["aoa_azimuth_deg"] += 25.0
        assert late_rms(tmp_path, rows) < 10.0


@pytest.mark.parametrize("seed", representative(range(4), 0))
def test_a_fifth_of_wrong_ranges_of_four_anchors_costs_little(tmp_path, seed):
    """Check ranges 1 to 6 m too long, 10 times a second; tracks began anew every three seconds."""
    rng = np.random.default_rng(seed)
    rows = rows_of(ROOM, np.arange(0.0, 30.0, 0.1).round(1), circle, noise=RANGES, seed=seed)
    for row in rows:
        row["range_m"] += rng.uniform(1.0, 6.0) * (rng.random() < 0.2)
    track = tracked(tmp_path, ROOM, rows, "imm-best", window=None)
    assert track.segment[-1] <= 2
    assert rms(errors(track, circle, track.x)[track.time_s > 10.0]) < 0.3


@pytest.mark.parametrize("seed", range(4))
def test_wrong_ranges_one_after_the_other_seldom_begin_a_track_anew(tmp_path, seed):
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 30.0, 0.025).round(3)
    rows = rows_of(ROOM, times, circle, seen=lambda n: [n % 4], noise=RANGES, seed=seed)
    for row in rows:
        row["range_m"] += abs(4.0 * rng.standard_normal()) * (rng.random() < 0.08)
    log = log_of(tmp_path, ROOM, rows)
    assert len(segments(log, ROOM, RADIO)) == 1
    findings = diagnose(Reading(log, ROOM, RADIO, named_modes("standard")["ukf"]))
    (as_it_is,) = (f for f in findings if f.hypothesis == AS_IT_IS)
    assert not any(c.group == "track" for c in as_it_is.contradictions)


@pytest.mark.parametrize("wrong", [None, 0, 1, 2])
def test_a_track_begins_in_spite_of_one_reflected_link_of_three(tmp_path, wrong):
    """Check a link 8 m too long and 30 degrees aside; without it, no link is left out."""
    nees = []
    for seed in range(20):
        rows = rows_of(WIDE, range(8), stroll, seed=seed)
        if wrong is not None:
            rows[wrong]["range_m"] += 8.0
            rows[wrong]["aoa_azimuth_deg"] += 30.0
        log = log_of(tmp_path, WIDE, rows)
        mean, covariance = start_at(log, 0, WIDE, RADIO).prior
        away = mean[:2] - stroll(0.0)[:2]
        nees.append(away @ np.linalg.solve(covariance[:2, :2], away))
        assert len(segments(log, WIDE, RADIO)) == 1
    assert np.mean(nees) < 3.2  # 99 % quantile of chi-square with 40 degrees of freedom, over 20


@pytest.mark.parametrize("anchors", [1, 32])
def test_many_ranges_begin_a_track_if_a_fifth_is_wrong_but_one_range_does_not(tmp_path, anchors):
    rng = np.random.default_rng(0)
    masts = np.column_stack([rng.uniform(0.0, 100.0, (anchors, 2)), rng.uniform(3, 9, anchors)])
    scene = scene_of_anchors("masts", masts, 28e9, 1e8)
    rows = rows_of(scene, [0.0], lambda t: np.array([40.0, 30.0, 1.5]), noise=RANGES)
    for row in rows[: anchors // 5]:
        row["range_m"] += 10.0
    log = log_of(tmp_path, scene, rows)
    start = start_at(log, 0, scene, RADIO)
    if anchors == 1:
        assert start is None
    else:
        assert_allclose(start.prior[0][:2], [40.0, 30.0], atol=0.3)


TWO = scene_of_anchors("two", np.array([[10.0, 10.0, 10.0], [10.0, 40.0, 10.0]]), 28e9, 1e8)
# name -> clock, place, deviation of azimuths (degrees), whether there are ranges, fewest starts
HONEST = {
    "a free clock, far beyond the anchors": ("free", [80.0, -100.0], 0.5, True, 90),
    "azimuths alone, nearby": ("synchronized", [40.0, 20.0], 3.0, False, 100),
    "azimuths alone that almost agree": ("synchronized", [45.0, -140.0], 3.0, False, 0),
}


@pytest.mark.parametrize("case", HONEST)
def test_starts_with_two_anchors_have_honest_covariances_or_wait(tmp_path, case):
    clock, horizontal, sigma_deg, ranges, fewest = HONEST[case]
    place = np.array([*horizontal, 1.5])
    rows = rows_of(TWO, range(100), lambda t: place)
    for row in rows:
        east, north, _ = place - TWO.anchors_m[int(row["anchor"]) - 1]
        azimuth = float(np.degrees(np.arctan2(north, east)))
        row["aoa_azimuth_deg"] = azimuth + (row["aoa_azimuth_deg"] - azimuth) * sigma_deg / 3.0
        row["aoa_azimuth_sigma_deg"] = sigma_deg
        row["range_m"] += 100.0 * row["time_s"] * (clock == "free")
        if not ranges:
            del row["range_m"], row["range_sigma_m"]
    log = log_of(tmp_path, TWO, rows, clock)
    starts = [start_at(log, epoch, TWO, RADIO) for epoch in range(100)]
    nees = []
    for mean, covariance in (start.prior for start in starts if start):
        error = mean[:2] - horizontal
        nees.append(error @ np.linalg.solve(covariance[:2, :2], error))
    # the mean of 100 squares of two normal errors is below 2.6 in 99.8 % of the cases
    assert len(nees) >= fewest and (not nees or np.mean(nees) < 2.6)
    assert fewest or not nees


def epochs_of(rows):
    """Return the rows of each epoch."""
    return [list(epoch) for _, epoch in groupby(rows, lambda row: row["time_s"])]


def live_as_in_log(tmp_path, scene, rows, policy, first):
    """Return the live positions of rows; check that from ``first`` on, they are those of a log."""
    track = tracked(tmp_path, scene, rows, policy, window=None)
    tracker = Tracker(scene, contender_from(policy, "standard"), RADIO)
    positions = [tracker.update(epoch) for epoch in epochs_of(rows)]
    assert_array_equal([p.position_m for p in positions[first:]], track.x[first:, :3])
    return positions


@pytest.mark.parametrize("reflected", [(), (0, 1), (1,)])
@pytest.mark.parametrize("policy", representative(["imm-best", "corrector"], "imm-best"))
def test_live_takes_back_a_start_and_equals_the_log_from_then_on(tmp_path, reflected, policy):
    def wrong(t, link):
        return [link[0] + 3.0, link[1] + 30.0] if t in reflected else link

    first = 8 if reflected else 0
    positions = live_as_in_log(tmp_path, ONE, rows_of(ONE, range(30), places, wrong), policy, first)
    begins = [p.begins for p in positions]
    assert begins.index(True) == 0 and any(begins[1:]) == bool(reflected)


def test_live_equals_the_log_if_votes_come_until_the_last_moment(tmp_path):
    def seen(number):
        return [a for a in range(3) if (number + a) % 3 or number < 2]

    rows = rows_of(WIDE, range(0, 120, 2), stroll, seen=seen, noise=BOTH | FAINT)
    rows[1]["range_m"] += 15.0
    rows[1]["aoa_azimuth_deg"] += 20.0
    live_as_in_log(tmp_path, WIDE, rows, "speed-rule", 8)


def test_live_finds_a_car_again_as_in_the_log_beside_another_user(tmp_path, monkeypatch):
    monkeypatch.setattr("mmwave_env.localization.localizer._CHUNK", 64)  # chunks begin everywhere
    rows = rows_of(WIDE, TURNING, block, noise=BOTH | FAINT)
    alone = live_as_in_log(tmp_path, WIDE, rows, "imm-best", 8)
    assert sum(position.begins for position in alone) > 8
    tracker = Tracker(WIDE, contender_from("imm-best", "standard"), RADIO)
    still = rows_of(WIDE, TURNING, lambda t: np.array([60.0, 30.0, 1.5]), noise=BOTH | FAINT)
    for row in still:
        row["ue"] = "other"
    for expected, ours, theirs in zip(alone, epochs_of(rows), epochs_of(still), strict=True):
        assert tracker.update_users([*ours, *theirs])[""] == expected


def test_live_takes_back_wrong_ranges_after_an_outage(tmp_path):
    times = [*range(60), *range(74, 100)]
    live_as_in_log(tmp_path, ROOM, rows_of(ROOM, times, street, outage), "speed-rule", -12)


def test_any_links_of_any_anchors_begin_a_track(tmp_path):
    rows = rows_of(ROOM, range(20), circle, seen=lambda n: [1, 2, 3])
    log = log_of(tmp_path, ROOM, rows)
    (segment,) = segments(log, ROOM, RADIO)
    assert segment.epochs == slice(0, 20)
    assert_allclose(segment.start.prior[0][:2], circle(0.0)[:2], atol=1.0)
