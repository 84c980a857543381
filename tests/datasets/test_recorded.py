"""Tests of recordings (exact ray-traced links) and of noisy episodes drawn from recordings."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.recorded import Recording, TrackSource
from mmwave_env.datasets.samples import read_track, sample_names
from mmwave_env.models.layout import Layout, wrapped
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import Scene, Wall
from mmwave_env.world.episode import EpisodeSource
from tests.filters.tracks import geometry, sampled
from tests.logs.by_hand import shown
from tests.refusals import refuses

EPOCHS = {"pedestrian": 400, "stop_and_go": 587, "vehicle": 120, "walk_ride_walk": 908}
VEHICLE = read_track("canyon28_vehicle")
PEDESTRIAN = read_track("canyon28_pedestrian")
RADIO = RADIOS["standard"]


def residuals(episode, recording, cut=slice(None)):
    """Return measured minus exact values (T, rows); ``cut`` selects epochs of the recording."""
    out = episode.measurement - recording.measurement[cut]
    angles = recording.layout.angles
    out[:, angles] = wrapped(out[:, angles])
    return out


def track(epochs=50, dt=1.0, odometry=False):
    """Return a recording of a straight walk past one wall, with all links visible."""
    scene = Scene("walk", (0.0, 0.0, 8.0), (Wall((0, 1), 20.0),))
    layout = Layout(2, odometry)
    time = dt * np.arange(epochs)
    velocity = np.tile([1.2, 0.3, 0.0], (epochs, 1))
    position = np.array([5.0, -6.0, 1.5]) + time[:, None] * velocity
    return Recording(
        name="walk",
        scene=scene,
        time_s=time,
        measurement=geometry(position, velocity, scene, layout),
        visible=np.ones((epochs, len(layout.groups)), bool),
        path_gain_db=np.full((epochs, 2), -90.0),
        position_m=position,
        velocity_mps=velocity,
        layout=layout,
    )


def test_the_samples_have_the_expected_names_and_lengths():
    assert sample_names() == tuple(f"canyon28_{name}" for name in EPOCHS)
    for name, epochs in zip(sample_names(), EPOCHS.values(), strict=True):
        recording = read_track(name)
        assert recording.name == name and len(recording) == epochs


def test_unknown_names_and_files_are_refused(tmp_path):
    for name in ("canyon", tmp_path / "nowhere", __file__):
        with refuses("episodes"):
            TrackSource(read_track(name), RADIO)


def test_a_track_source_gives_the_episode_of_a_recording():
    source: EpisodeSource = TrackSource(VEHICLE, RADIO)
    episode = sampled(source)
    assert source.layout == episode.layout == Layout(3)
    assert source.epochs == len(episode) == 120
    assert source.name == episode.name == "canyon28_vehicle"
    assert episode.nonfinite == 0
    assert np.isfinite(episode.table()).all()
    assert_array_equal(episode.truth_velocity_mps, VEHICLE.velocity_mps)
    assert_array_equal(episode.scene_anchors_m, VEHICLE.anchors_m)
    assert episode.hz_per_mps == pytest.approx(28e9 / 299_792_458.0)


def test_sigmas_follow_from_the_radio_profile_and_the_recorded_gain():
    episode = sampled(TrackSource(VEHICLE, RADIO))
    visible = VEHICLE.visible[:, :3]
    snr_db = RADIO.snr_db(VEHICLE.path_gain_db, 100e6)
    assert_allclose(episode.snr_db[visible], snr_db[visible])
    assert_array_equal(episode.sigma, RADIO.sigma(episode.snr_db, VEHICLE.scene, VEHICLE.layout))
    assert (episode.snr_db[~visible] < -50.0).all()


@pytest.mark.parametrize("radio", RADIOS.values(), ids=RADIOS)
def test_the_covariance_of_the_prior_is_right(radio):
    scores = []
    for seed in range(400):
        episode = PEDESTRIAN.part(slice(0, 1)).episode(radio, np.random.default_rng(seed))
        truth = np.append(episode.truth_position_m[0], episode.truth_velocity_mps[0])
        variances = np.diag(episode.prior_covariance)[:6]
        scores.append(np.square(episode.prior_mean[:6] - truth) / variances)
    assert_array_equal(episode.prior_covariance, radio.prior_covariance(PEDESTRIAN.scene))
    assert np.mean(scores) == pytest.approx(1.0, rel=0.1)


def test_noise_divided_by_sigma_has_unit_variance():
    source = TrackSource(PEDESTRIAN, RADIO)
    rows = shown(PEDESTRIAN)[:, :-1]
    scores = []
    for seed in range(20):
        episode = sampled(source, seed)
        scores.append((residuals(episode, PEDESTRIAN) / episode.sigma)[:, :-1])
    scores = np.array(scores)
    for row in range(rows.shape[1]):
        z = scores[:, rows[:, row], row]
        assert abs(z.mean()) < 4.0 / np.sqrt(z.size)
        assert abs(z.var() - 1.0) < 4.0 * np.sqrt(2.0 / z.size)


def test_the_oscillator_bias_is_a_random_walk_as_in_the_profile():
    recording = track(epochs=200, dt=4.0)
    quiet = replace(RADIO, doppler_floor_mps=1.1e-3, doppler_window_s=1e6)
    source = TrackSource(recording, quiet)
    drawn = [residuals(sampled(source, seed), recording) for seed in range(200)]
    walks = np.array(drawn)[:, :, -1] / recording.scene.hz_per_mps
    assert np.std(walks[:, 0]) == pytest.approx(RADIO.prior_bias_mps, rel=0.2)
    steps = np.diff(walks, axis=1)
    assert np.std(steps) == pytest.approx(RADIO.drift_mps * 2.0, rel=0.02)
    assert abs(np.mean(steps)) < 4.0 * np.std(steps) / np.sqrt(steps.size)


def test_doppler_spread_follows_the_speed():
    source = TrackSource(VEHICLE, replace(RADIO, spread_floor_mps=0.0))
    speed = np.linalg.norm(VEHICLE.velocity_mps, axis=1)
    spreads = np.array([sampled(source, s).doppler_spread_hz for s in range(50)])
    ratio = np.log(spreads / (RADIO.spread_gain * speed * VEHICLE.scene.hz_per_mps))
    assert abs(ratio.mean()) < 0.01
    assert ratio.std() == pytest.approx(RADIO.spread_sigma, rel=0.05)


@settings(max_examples=30)
@given(epochs=st.integers(1, 120), seed=st.integers(0, 99))
def test_an_episode_is_a_contiguous_part_of_the_recording(epochs, seed):
    episode = sampled(TrackSource(VEHICLE, RADIO, epochs=epochs), seed)
    first = int(np.flatnonzero(VEHICLE.time_s == episode.time_s[0])[0])
    cut = slice(first, first + epochs)
    assert len(episode) == epochs
    assert_array_equal(episode.time_s, VEHICLE.time_s[cut])
    noise = residuals(episode, VEHICLE, cut)[:, :-1] / episode.sigma[:, :-1]
    assert np.nanmax(np.abs(noise)) < 6.0
    assert_array_equal(episode.visible, VEHICLE.visible[cut])
    assert_array_equal(episode.truth_position_m, VEHICLE.position_m[cut])


def test_odometry_is_kept_and_its_noise_has_the_standard_deviation_sigma():
    recording = track(odometry=True)
    episode = sampled(TrackSource(recording, RADIO))
    assert episode.visible.shape == (50, 4)
    scores = residuals(episode, recording)[:, -2:] / episode.sigma[:, -2:]
    assert scores.std() == pytest.approx(1.0, rel=0.3)
