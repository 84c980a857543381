"""Tests that folders with log, scene and true track are written, read and played as episodes."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal, assert_array_max_ulp

from mmwave_env.datasets.log_folder import read_log_folder, write_log_folder
from mmwave_env.datasets.recorded import MeasuredTrack, Recording, TrackSource
from mmwave_env.datasets.samples import read_track, sample_folder
from mmwave_env.logs.tum import tum_lines
from mmwave_env.models.scene import SCENES, read_scene
from tests.cli import assert_refused, succeed
from tests.filters.tracks import assert_same_fields, sampled, seeded
from tests.localization.mistakes import read_columns, write_columns
from tests.logs.by_hand import shown, write_log
from tests.paths import LOGS, RECORDINGS
from tests.refusals import refuses

STREET = SCENES["street"]


def simulated(seed=3, odometry=False):
    return seeded(seed, scenario="vehicle", odometry=odometry)


@pytest.fixture
def folder(tmp_path):
    write_log_folder(tmp_path, simulated(), STREET, "made by a test")
    return tmp_path


@pytest.mark.parametrize("odometry", [False, True])
def test_a_simulated_log_gives_the_simulated_episode(tmp_path, odometry):
    true = simulated(3, odometry)
    write_log_folder(tmp_path, true, STREET, "made by a test")
    assert read_scene(tmp_path / "scene.json") == STREET
    episode = sampled(TrackSource(read_track(tmp_path), "handset"))
    assert episode.layout == true.layout and episode.name == tmp_path.name
    fields = ("time_s", "usable", "doppler_spread_hz", "scene_anchors_m", "truth_position_m")
    assert_same_fields(episode, true, *fields)
    at = np.repeat(true.usable, true.layout.widths, axis=1)
    # Writing a log divides ranges by the speed of light; reading multiplies them by it again.
    assert_array_max_ulp(episode.measurement[at], true.measurement[at])
    assert_array_max_ulp(episode.sigma[at], true.sigma[at], maxulp=4)


def test_the_log_can_be_gzipped(folder):
    plain = read_log_folder(folder)
    (folder / "log.csv").unlink()
    write_log(folder / "log.csv.gz", simulated())
    packed = read_log_folder(folder)
    assert_array_equal(packed.measurement, plain.measurement)


def test_epochs_are_matched_to_poses_by_time(folder):
    track = read_log_folder(folder)
    early = slice(10, 150)
    lines = tum_lines(track.time_s[early], track.position_m[early])
    (folder / "truth.tum").write_text(lines)
    with pytest.warns(UserWarning, match="140 epochs"):
        episode = sampled(TrackSource(read_track(folder), "handset"))
    assert_array_equal(episode.truth_position_m, track.position_m[early])
    assert_array_equal(episode.time_s, track.time_s[early])


def test_a_log_with_sigma_columns_and_missing_quantities_can_be_played_and_written_again(folder):
    """Check a log without SNRs and angles of arrival, whose Doppler shifts belong to anchor 2."""
    whole = read_log_folder(folder)
    columns = read_columns(folder / "log.csv")
    own = {name: columns[name] for name in ("time_s", "anchor", "toa_s", "aod_azimuth_rad")}
    own["doppler_hz"] = np.roll(columns["doppler_hz"], 1)  # moved to anchor 2's rows
    for sigma, name, value in (
        ("range_sigma_m", "toa_s", 0.4),
        ("aod_azimuth_sigma_rad", "aod_azimuth_rad", 0.03),
        ("doppler_sigma_hz", "doppler_hz", 25.0),
    ):
        own[sigma] = np.where(np.isfinite(own[name]), value, np.nan)
    write_columns(folder / "log.csv", own)
    track = read_log_folder(folder)
    episode = sampled(TrackSource(track, "handset"))
    assert track.layout == replace(whole.layout, partial=True)
    seen = shown(whole) & ([True, False, False, True] * 3 + [True])
    assert_array_equal(np.isfinite(episode.measurement), seen)
    assert_array_equal(track.measurement[seen], whole.measurement[seen])
    expected = np.tile([0.4, 1.0, 1.0, 0.03] * 3 + [25.0], (len(track), 1))
    assert_array_equal(episode.sigma[seen], expected[seen])
    assert (episode.doppler_anchor[whole.visible[:, 3]] == 1).all()
    write_log_folder(folder, episode, STREET, "made by a test")
    again = sampled(TrackSource(read_log_folder(folder), "handset"))
    assert_array_max_ulp(again.table(), episode.table(), maxulp=2)


@pytest.mark.parametrize("name", ["canyon28_pedestrian", "canyon28_vehicle"])
def test_samples_are_found_by_name_and_by_folder_and_their_layout_is_not_partial(name):
    assert sample_folder(name) == LOGS / name
    assert sample_folder(name, "recording") == RECORDINGS / name
    for where in (name, RECORDINGS / name):
        assert isinstance(TrackSource(read_track(where), "standard").track, Recording)
    log = TrackSource(read_track(LOGS / name), "standard")
    assert isinstance(log.track, MeasuredTrack) and log.name == name
    assert not log.layout.partial and log.track.sigma is log.track.doppler_anchor is None
    recorded = sampled(TrackSource(read_track(name), "standard"))
    played = sampled(log)
    assert_array_equal(played.usable, recorded.usable)


def test_a_recording_is_not_found_as_a_log():
    with refuses("sample"):
        sample_folder("canyon28_stop_and_go")


@pytest.mark.parametrize("names", [["truth.tum"], ["log.csv", "scene.json", "truth.tum"]])
def test_missing_files_are_named(folder, names):
    for name in names:
        (folder / name).unlink()
    with pytest.raises(ValueError, match=f"found no {', no '.join(names)}"):
        TrackSource(read_track(folder), "handset")


def test_two_logs_are_refused(folder):
    shutil.copy(folder / "log.csv", folder / "log.parquet")
    with refuses(folder):
        TrackSource(read_track(folder), "handset")


def test_commands_accept_a_log_folder_as_data(folder):
    text = succeed("compare", "--policies", "fixed-ukf", "imm", "--data", folder, "--episodes", 3)
    assert f"### {folder.name}, handset, 3 episodes" in text
    (folder / "scene.json").unlink()
    assert_refused(
        f"{folder}: found no scene.json, expected", "compare", "--policies", "imm", "--data", folder
    )
