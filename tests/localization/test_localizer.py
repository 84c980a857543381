"""Tests of tracks from logs: filters, smoothing, gaps, where tracks begin, and sizes of blocks."""

from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import run_imm
from mmwave_env.filters.bank import Bank, best_bank, default_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.localizer import Localizer, localize
from mmwave_env.localization.starts import start_at
from mmwave_env.logs.log import Log, read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.layout import Layout
from mmwave_env.models.prior import prior_from_fix
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, Scene
from mmwave_env.world.episode import Episode
from policies.corrector import TWO_WAY, TwoWayCorrector
from policies.rules import by_odometry_speed, by_predicted_speed
from tests.filters.tracks import drawn, geometry, track
from tests.logs.by_hand import assert_same, damaged, log_with, write_log
from tests.paths import representative

SCENE = SCENES["street"]
RADIO = RADIOS["handset"]
T = 230
SHIFT = 3  # index of the group with the Doppler shift
EKF, UKF = default_modes()
BANK = best_bank()
filtered_or_smoothed = pytest.mark.parametrize(
    ("modes", "window"), [((EKF,), None), ((EKF,), 1000), (BANK, 30)]
)


@cache
def log(folder, odometry=False):
    """Return a log with uneven time steps; nothing is measured in the first two epochs."""
    episode = drawn(3, scenario="mixed", epochs=T, odometry=odometry, dt=0.2)
    time = 1.7e9 + np.random.default_rng(0).uniform(0.1, 0.3, T).cumsum()
    visible = episode.visible.copy()
    visible[:2] = False
    visible[2, 0] = True
    path = folder / f"log{odometry}.csv"
    write_log(path, replace(episode, time_s=time, visible=visible))
    block = read_log(path, SCENE).whole()
    assert len(block) == T and not block.visible[:2].any() and block.visible[2, 0]
    return block


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def block(folder):
    return log(folder)


def run(log, modes=(EKF,), rule=None, **options):
    return localize(log, SCENE, RADIO, Switching(modes, rule), **options)


def filtered(log, modes):
    """Return the localizer of a log that begins with a line of sight, and its filtered beliefs."""
    localizer = Localizer(log.layout, SCENE, RADIO, Switching(modes))
    localizer.load(log, start_at(log, 0, SCENE, RADIO))
    return localizer, localizer.run(localizer.engine, log.time_s[None])


def episode_of(block):
    """Return the log as an episode that begins with the first line of sight, in epoch 2."""
    block = block.part(slice(2, None))
    sigma = RADIO.sigma(block.snr_db, SCENE, block.layout)
    anchor = SCENE.anchors_m[0]
    link = block.layout.link(0)
    prior = prior_from_fix(anchor, block.measurement[0, link], sigma[0, link], RADIO, SCENE)
    visible = block.visible.copy()
    visible[0, 0] = False
    arrays = block.measurement, sigma, visible, block.snr_db, block.doppler_spread_hz
    site = SCENE.anchors_m, SCENE.hz_per_mps
    return Episode("log", *site, block.time_s, *arrays, *prior, block.layout)


# --- filtered


def assert_engines(result, block, modes, planar=False):
    """Assert that an engine that runs the modes chosen in ``result`` filters the same track."""
    episode = episode_of(block)
    if planar:
        prior = episode.prior_mean.copy()
        prior[2] = 1.5
        episode = replace(episode, prior_mean=prior)
    ours = {"x": result.x, "P": result.P}
    ours |= {"memory.nis": result.nis, "memory.accepted": result.accepted}
    pipeline = Pipeline(tuple(modes), block.layout, planar)
    theirs = track(pipeline, [episode], result.mode[:, None], T - 2, ours)
    for name, values in ours.items():
        assert_allclose(values, theirs[name][:, 0], rtol=1e-9, atol=1e-9, err_msg=name)
    assert_array_equal(result.time_s, episode.time_s)
    assert_array_equal(result.visible, episode.usable)
    assert_array_equal(result.incomplete, block.incomplete[2:])
    assert result.skipped == 2 and (~result.visible[0, 0]).all()


@pytest.mark.parametrize("odometry", representative([False, True], False))
def test_the_speed_predicted_or_measured_by_odometry_chooses_the_mode(folder, odometry):
    block = log(folder, odometry)
    rule = by_odometry_speed if odometry else by_predicted_speed
    result = run(block, (EKF, UKF), rule)
    assert_engines(result, block, (EKF, UKF))
    speed = np.concatenate([[0.0], np.linalg.norm(result.x[:-1, 3:6], axis=1)])
    if odometry:
        measured = result.visible[:, -1]
        speed = np.where(measured, block.measurement[2:, -2], speed)
        assert measured.any() and not measured.all()
    assert_array_equal(result.mode, speed > 2.0)
    assert 0.1 < result.mode.mean() < 0.9


@pytest.mark.parametrize("modes", representative([(EKF,), BANK], (EKF,)))
def test_a_track_on_flat_terrain_keeps_its_height(block, modes):
    result = run(block, modes, height_m=1.5)
    if modes != BANK:
        assert_engines(result, block, modes, planar=True)
    for x in (result.x, result.smooth_x):
        assert_allclose(x[:, 2], 1.5, rtol=1e-12 if modes == BANK else 0.0)
        assert not x[:, 5].any()


@pytest.mark.parametrize("chunk", [1, 50])
def test_a_track_of_an_imm_equals_the_track_of_the_imm_engine(monkeypatch, block, chunk):
    monkeypatch.setattr("mmwave_env.localization.localizer._CHUNK", chunk)
    result = run(block, BANK, window=None)
    ours = {"x": result.x, "P": result.P, "memory.nis": result.nis}
    names = (*ours, "mixture.probability")
    theirs = run_imm(BANK, None, [episode_of(block)], *names)
    for name, values in ours.items():
        assert_allclose(values, theirs[name][0], rtol=1e-9, atol=1e-9, err_msg=name)
    assert_array_equal(result.mode, theirs["mixture.probability"][0].argmax(axis=1))
    assert not result.nis[~result.visible].any()
    assert len(np.unique(result.mode)) > 2


# --- smoothed


@pytest.mark.parametrize(
    ("modes", "window"), [*(((EKF,), window) for window in (2, 57, T - 2, 1000)), (BANK, 57)]
)
def test_every_window_is_smoothed_including_a_shorter_last_one(monkeypatch, block, window, modes):
    monkeypatch.setattr("mmwave_env.localization.localizer._CHUNK", 64)
    result = run(block, modes, window=window)
    localizer, beliefs = filtered(block.part(slice(2, None)), modes)
    for first in range(0, T - 2, window):
        part = slice(first, first + window)
        values = (beliefs["kept"][0], result.time_s, result.doppler_spread_hz)
        x, P = localizer.smoothed(*(v[None, part] for v in values))
        assert_allclose(result.smooth_x[part], x[0], rtol=1e-12, atol=1e-12)
        assert_allclose(result.smooth_P[part], P[0], rtol=1e-12, atol=1e-12)
    assert not np.array_equal(result.smooth_x, result.x)


def test_without_smoothing_the_track_is_the_filtered_track(block):
    result = run(block, window=None)
    assert_array_equal(result.smooth_x, result.x)
    assert_array_equal(result.x, run(block).x)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("modes", "rule", "two_way"),
    [((EKF, UKF), by_predicted_speed, None), (BANK, None, None), (BANK, None, TWO_WAY)],
    ids=["rule", "imm", "two ways"],
)
@settings(max_examples=6)
@given(size=st.integers(1, T), window=st.integers(2, 300))
def test_a_track_does_not_depend_on_the_sizes_of_chunks(folder, modes, rule, two_way, size, window):
    block = log(folder)
    first, second = with_gap(unseen(block, slice(101, 104)), 40.0)
    block = Log.joined([first, *with_gap(second, 20.0, at=30)])
    options = {"window": window, "two_way": two_way and TwoWayCorrector(two_way)}
    expected = run(block, modes, rule, **options)
    with patch("mmwave_env.localization.localizer._CHUNK", size):
        result = run(block, modes, rule, **options)
    if two_way:  # the corrector's network computes in single precision
        assert_allclose(result.smooth_x, expected.smooth_x, rtol=0.0, atol=1e-4)
    else:
        assert_same(result, expected)
    for name in ("skipped", "dropped"):
        assert getattr(result, name) == getattr(expected, name)
    assert expected.segment[-1] == 2


# --- where a track begins and ends


def unseen(block, epochs):
    """Return the log without the line of sight in some epochs."""
    visible = block.visible.copy()
    incomplete = block.incomplete.copy()
    visible[epochs, 0] = False
    incomplete[epochs, 0] = True
    return replace(block, visible=visible, incomplete=incomplete)


@filtered_or_smoothed
def test_the_track_before_a_damaged_line_is_returned_with_the_error(block, window, modes):
    sound = block.part(slice(0, 130))
    result = run(damaged(sound), modes, window=window)
    assert "line 7" in str(result.damage)
    assert_same(result, run(sound, modes, window=window))
    assert len(result) == 128


UNGATED = replace(UKF, gate=None)
TWINS = Bank((UNGATED, replace(UNGATED, name="twin")))


@pytest.mark.parametrize("modes", representative([(UNGATED,), TWINS], (UNGATED,)))
@pytest.mark.parametrize(("first", "window"), [(1, None), (100, 30)])
def test_a_measurement_that_makes_a_track_infinite_is_refused(block, first, window, modes):
    measurement = block.measurement.copy()
    visible = block.visible.copy()
    measurement[2 + first, block.layout.doppler] = 1e300
    visible[2 + first, SHIFT] = True
    wrong = replace(block, measurement=measurement, visible=visible)
    result = run(wrong, modes, window=window)
    assert isinstance(result.damage, LogError) and "time" in str(result.damage)
    # The belief may still be finite in the damaged epoch, but not in the next epoch.
    assert len(result) in (first, first + 1) and np.isfinite(result.smooth_x).all()


# --- gaps


def with_gap(block, seconds, at=100):
    """Return the log before and after a pause; the second part begins with a line of sight."""
    time = block.time_s.copy()
    time[at:] += seconds - (time[at] - time[at - 1])
    fix = at + int(block.visible[at:, 0].argmax())
    return block.part(slice(at)), replace(block, time_s=time).part(slice(fix, None))


@filtered_or_smoothed
def test_after_a_long_gap_the_track_equals_the_track_of_the_remaining_log(block, window, modes):
    before, after = with_gap(block, 60.0)
    whole = run(Log.joined([before, after]), modes, window=window)
    for number, (result, part) in enumerate(zip(whole.by_segment(), (before, after), strict=True)):
        assert (result.segment == number).all()
        assert_same(replace(result, segment=0 * result.segment), run(part, modes, window=window))
    assert whole.skipped == 2 and whole.dropped == 0


@pytest.mark.parametrize(("steep", "side"), [(0.0, -1.0), (1e-9, 1.0), (0.02, -1.0)])
@pytest.mark.parametrize("images", [0, 1])
def test_a_track_starts_straight_below_or_above_an_anchor_only_if_another_one_is_seen(
    steep, side, images
):
    scene = Scene("lamp", (3.0, 4.0, 10.0), virtual_anchors_m=((3.0, 34.0, 10.0),)[:images])
    layout = Layout(1 + images)
    first = 4 - 4 * images
    epochs = 60
    # The user stands below or above the base station for four epochs, then walks away.
    along = np.concatenate([np.full(4, steep), 1.5 * np.arange(1, epochs - 3)])
    position = [3.0, 4.0, 10.0 + 8.0 * side] + along[:, None] * [1.0, 0.0, 0.0]
    velocity = np.where(along > steep, 1.5, 0.0)[:, None] * [1.0, 0.0, 0.0]
    rows = geometry(position, velocity, scene, layout)
    block = log_with(
        layout, np.arange(60.0), rows, np.ones((epochs, 2 + images), bool), snr_db=30.0
    )
    result = localize(block, scene, RADIO, Switching((EKF,)), window=None)
    assert result.skipped == first
    error = np.linalg.norm(result.x[:, :3] - position[first:], axis=1)
    # Without the base station's angles, the first position assumes the height of the streets.
    assert error[images:].max() < 1.0
