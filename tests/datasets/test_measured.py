"""Tests of measured tracks, the episodes from them, and recordings from arrays."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.recorded import MeasuredTrack, Recording, TrackSource
from mmwave_env.datasets.samples import read_track
from mmwave_env.logs.truth import stretches, velocity_of
from mmwave_env.models.layout import LINK, Layout
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import scene_of_anchors
from tests.filters.tracks import sampled, street_source
from tests.logs.by_hand import shown
from tests.paths import representative
from tests.refusals import refuses

RADIO = "handset"


def simulated(seed=3, epochs=60, radio="handset", scenario="vehicle"):
    return sampled(street_source(scenario, radio, epochs=epochs), seed)


def links(record, visible):
    """Return the measurements of links: arrays (T, L) by name, NaN where a link is not visible."""
    rows = record.measurement[:, : record.layout.doppler].reshape(len(record), -1, 4)
    return {name: np.where(visible, rows[:, :, i], np.nan) for i, name in enumerate(LINK)}


def arrays(episode):
    """Return, by name, the arrays of an episode that :func:`track` can change."""
    return links(episode, episode.usable[:, :3]) | {
        "time_s": episode.time_s,
        "anchors_m": episode.scene_anchors_m,
        "position_m": episode.truth_position_m,
    }


def track(episode=None, **changes):
    """Return an episode as a measured track, with some arrays changed."""
    episode = episode or simulated()
    own = arrays(episode) | changes
    measurement = episode.measurement.copy()
    for i, name in enumerate(LINK):
        measurement[:, i : episode.layout.doppler : 4] = own[name]
    return MeasuredTrack(
        name="own",
        scene=scene_of_anchors("own", own["anchors_m"], 28e9, 100e6),
        layout=episode.layout,
        time_s=own["time_s"],
        measurement=measurement,
        visible=episode.usable,
        snr_db=episode.snr_db,
        doppler_spread_hz=episode.doppler_spread_hz,
        position_m=own["position_m"],
        velocity_mps=velocity_of(own["time_s"], own["position_m"], GAP_S),
    )


# --- wrong conventions and units


def exchanged(a):
    return {f"ao{x}_azimuth_rad": a[f"ao{y}_azimuth_rad"] for x, y in ("ad", "da")}


MISTAKES = {  # name -> (function that returns the changed arrays, array that the warning names)
    "exchanged": (exchanged, "aod_azimuth_rad of anchor 1"),
    "upside down": (lambda a: {"aoa_elevation_rad": -a["aoa_elevation_rad"]}, "aoa_elevation_rad"),
    "turned": (lambda a: {"aoa_azimuth_rad": a["aoa_azimuth_rad"] + 0.2}, "aoa_azimuth_rad"),
    "round trip": (lambda a: {"range_m": 2.0 * a["range_m"]}, "range_m of anchor 1"),
    "anchors reversed": (lambda a: {"anchors_m": a["anchors_m"][::-1]}, "anchor 3"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_values_that_contradict_the_truth_cause_a_warning(name):
    change, column = MISTAKES[name]
    episode = simulated(radio="standard")
    with pytest.warns(UserWarning, match=f"track 'own': .*{column}"):
        TrackSource(track(episode, **change(arrays(episode))), RADIO)


@pytest.mark.parametrize("seeds", representative([range(20), range(20, 354)], range(20)))
def test_correct_tracks_cause_no_warning(seeds):
    for seed in seeds:
        for radio in RADIOS:
            TrackSource(track(simulated(seed, 200, radio, "mixed")), radio)


# --- episodes


def test_seeds_change_the_prior_and_nothing_else():
    source = TrackSource(track(), "handset")
    first = sampled(source, 5)
    same = sampled(source, 5)
    other = sampled(source, 6)
    assert_array_equal(first.table(), other.table())
    assert_array_equal(first.prior_mean, same.prior_mean)
    assert (first.prior_mean[:6] != other.prior_mean[:6]).all() and first.prior_mean[6] == 0.0
    truth = [*first.truth_position_m[0], *first.truth_velocity_mps[0]]
    deviation = np.sqrt(np.diag(first.prior_covariance))[:6]
    assert (abs(first.prior_mean[:6] - truth) < 5.0 * deviation).all()
    assert source.epochs == len(first) == 60 and source.layout == Layout(3)


@settings(max_examples=100)
@given(
    known=st.lists(st.booleans(), min_size=1, max_size=30),
    steps=st.lists(st.sampled_from([0.1, 1.0, GAP_S, GAP_S + 0.1]), min_size=29, max_size=29),
)
def test_stretches_are_runs_of_epochs_with_known_truth_and_without_a_gap(known, steps):
    time = np.concatenate([[0.0], np.cumsum(steps)])[: len(known)]
    position = np.where(np.array(known)[:, None], np.outer(time, [1.0, -2.0, 0.5]), np.nan)
    runs = stretches(time, position, GAP_S)
    links = np.zeros(len(known) - 1, int)  # number of runs that contain an epoch and the next one
    inside = np.zeros(len(known), bool)
    for run in runs:
        assert run.stop - run.start >= 2
        links[run.start : run.stop - 1] += 1
        inside[run] = True
    for i, count in enumerate(links):
        assert count == (known[i] and known[i + 1] and time[i + 1] - time[i] <= GAP_S)
    velocity = velocity_of(time, position, GAP_S)
    assert (np.isfinite(velocity).all(axis=1) == inside).all()
    assert_allclose(velocity[inside] - [1.0, -2.0, 0.5], 0.0, atol=1e-9)


def broken():
    """Return a track of 60 epochs; 20 and 21 lack a true position or velocity, 50 follows a gap."""
    episode = simulated()
    position = episode.truth_position_m.copy()
    velocity = episode.truth_velocity_mps.copy()
    time = episode.time_s.copy()
    position[20] = np.nan
    velocity[21] = np.nan
    time[50:] += 20.0
    return replace(track(position_m=position, time_s=time), velocity_mps=velocity)


def test_episodes_lie_within_stretches():
    source = TrackSource(broken(), RADIO, epochs=10)
    starts = {int(sampled(source, seed).time_s[0]) for seed in range(300)}
    assert starts == {*range(11), *range(22, 41), 70}


def test_without_a_number_of_epochs_the_longest_stretch_is_played():
    with pytest.warns(UserWarning, match="28 epochs"):
        source = TrackSource(broken(), RADIO)
    assert {sampled(source, seed).time_s[0] for seed in range(20)} == {22.0}
    assert source.epochs == 28


@pytest.mark.parametrize("epochs", [0, 29])
def test_episodes_that_are_empty_or_longer_than_every_stretch_are_refused(epochs):
    with refuses("epochs"):
        TrackSource(broken(), RADIO, epochs)


def test_a_track_without_truth_or_with_times_in_milliseconds_is_refused():
    with refuses("track 'own'"):
        TrackSource(track(position_m=np.full((60, 3), np.nan)), RADIO)
    with refuses("track 'own'"):
        TrackSource(track(time_s=1e3 * np.arange(60)), RADIO)


def test_the_environment_accepts_a_track_or_a_recording():
    for own in (track(), read_track("canyon28_vehicle")):
        env = gym.make("mmwave_env:MmWaveLoc-v0", episodes=own, radio="standard", episode_steps=25)
        assert env.unwrapped.radio == RADIOS["standard"] and env.unwrapped.source.epochs == 25
        assert env.reset(seed=1)[1]["episode_name"] == own.name


# --- recordings from arrays


def test_a_recording_can_be_made_from_arrays():
    true = read_track("canyon28_pedestrian")
    visible = true.visible[:, :3]
    same = {name: getattr(true, name) for name in ("name", "time_s", "anchors_m", "position_m")}
    gain = {"path_gain_db": np.where(visible, true.path_gain_db, np.nan)}
    own = same | gain | links(true, visible)
    recording = Recording.from_arrays(**own, velocity_mps=true.velocity_mps)
    assert_array_equal(recording.visible, true.visible)
    at = shown(true)
    assert_allclose(recording.measurement[at], true.measurement[at], rtol=1e-12)
    assert recording.scene == true.scene
    by_differences = Recording.from_arrays(**own)
    assert abs(by_differences.velocity_mps - true.velocity_mps).max() < 0.5
    with refuses("path_gain_db of recording"):
        Recording.from_arrays(**{**own, "path_gain_db": [1.0]})
    exchanged = Recording.from_arrays(**{**own, "aoa_azimuth_rad": own["aod_azimuth_rad"]})
    with pytest.warns(UserWarning, match="aoa_azimuth_rad of anchor 1"):
        TrackSource(exchanged, RADIO)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("path_gain_db", np.zeros((60, 2))),
        ("position_m", np.zeros((60, 2))),
        ("anchors_m", [1.0, 2.0, 3.0]),
        ("time_s", np.zeros(60)),
        ("carrier_hz", 28.0),
    ],
)
def test_the_error_names_an_array_of_a_wrong_shape_or_value(field, value):
    own = arrays(simulated()) | {"path_gain_db": np.full((60, 3), -90.0), field: value}
    with refuses(field):
        Recording.from_arrays(**own)
