"""Tests of logs that lack values or have standard deviations, and of choosing a radio for a log."""

import numpy as np
import pytest

from mmwave_env.localization.log_noise import nearest_radio
from mmwave_env.localization.starts import start_at
from mmwave_env.logs.log import read_log
from mmwave_env.logs.truth import Truth
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.radio import RADIOS
from tests.cli import succeed
from tests.localization.mistakes import read_columns, write_columns
from tests.localization.test_live_epochs import SCENE, WALK
from tests.logs.by_hand import refuses_log

COLUMNS = read_columns(WALK / "log.csv")
LINK = ("toa_s", "aoa_azimuth_rad", "aoa_elevation_rad", "aod_azimuth_rad")


def written(folder, names, **others):
    """Write a log with some of the walk's columns, and with other columns: arrays or constants."""
    columns = {name: COLUMNS[name] for name in names} | others
    length = len(COLUMNS["anchor"])
    path = folder / "log.csv"
    write_columns(path, {k: np.broadcast_to(values, length) for k, values in columns.items()})
    return path


def read(path, **options):
    return read_log(path, SCENE, **options)


def test_a_link_that_lacks_one_value_is_used_with_its_other_values(tmp_path):
    lacks = COLUMNS["anchor"] % 4  # index in LINK of the value that a row lacks
    links = {name: np.where(lacks == i, np.nan, COLUMNS[name]) for i, name in enumerate(LINK)}
    block = read(written(tmp_path, ("time_s", "anchor", "doppler_hz", "snr_db"), **links))
    whole = read(WALK / "log.csv")
    np.testing.assert_array_equal(block.visible, whole.visible)
    measured = np.isfinite(block.measurement)
    before = np.isfinite(whole.measurement)
    assert (measured.sum(axis=0) == before.sum(axis=0) * (measured.any(axis=0))).all()
    assert (~measured.any(axis=0)).sum() == 3  # each link lacks the same quantity in all epochs


def test_standard_deviations_in_a_log_are_used_and_make_an_snr_unnecessary(tmp_path):
    sigmas = {"toa_sigma_ns": 2.0, "aoa_azimuth_sigma_deg": 1.0, "doppler_sigma_mps": 0.5}
    columns = ("time_s", "anchor", "toa_s", "aoa_azimuth_rad", "doppler_hz")
    block = read(written(tmp_path, columns, **sigmas))
    expected = (2e-9 * SPEED_OF_LIGHT, np.radians(1.0), 0.5 * SCENE.hz_per_mps)
    for row, value in zip((0, 1, block.layout.doppler), expected, strict=True):
        sigma = block.sigma[:, row]
        np.testing.assert_allclose(sigma[np.isfinite(sigma)], value, rtol=1e-12)
    assert np.isnan(block.sigma[:, 2]).all() and not np.isfinite(block.snr_db).any()


def test_a_log_without_noise_columns_is_refused_unless_an_snr_is_given(tmp_path):
    path = written(tmp_path, ("time_s", "anchor", "toa_s", "aoa_azimuth_rad"))
    with refuses_log("columns"):
        read(path)
    with refuses_log("snr"):
        read(path, snr_db=np.nan)
    assert read(path, snr_db=15.0).visible.any()


def test_ranges_to_anchors_on_a_line_begin_no_track_because_a_mirrored_one_fits_as_well(tmp_path):
    names = ("time_s", "anchor", "toa_s", "aoa_elevation_rad", "snr_db")
    for columns, begins in ((names, False), ((*names, "aoa_azimuth_rad"), True)):
        block = read(written(tmp_path, columns))
        rows = [block.part(slice(n, n + 1)) for n in range(0, 400, 20)]
        assert any(start_at(row, 0, SCENE, RADIOS["standard"]) for row in rows) == begins


@pytest.mark.parametrize("x", [-30.0, 20.0])
def test_the_side_of_the_user_decides_between_mirrored_positions(tmp_path, x):
    path = written(tmp_path, ("time_s", "anchor", "toa_s", "aoa_elevation_rad", "snr_db"))
    out = tmp_path / "track.tum"
    scene = ("--scene", WALK / "scene.json", "--radio", "standard", "--start", f"{x},0")
    succeed("localize", path, *scene, "--no-smoothing", "--speed", "1", "--out", out)
    times, *track = np.loadtxt(out).T[:3]
    early = times < times[0] + 12.0  # later, the walk crosses the line of the anchors
    truth_x, truth_y, _ = Truth(WALK / "truth.tum").at(times).T
    mirrored = truth_x if x < -5.0 else -10.0 - truth_x
    error_m = np.hypot(track[0] - mirrored, track[1] - truth_y)[early]
    assert error_m.mean() < 1.0


@pytest.mark.parametrize(
    ("field", "names", "others"),
    [
        ("columns", ("aoa_elevation_rad", "snr_db"), {}),
        ("columns", ("doppler_hz", "snr_db"), {}),
        ("range_sigma_m", ("toa_s",), {"range_sigma_m": 1e-5}),
        ("doppler_hz", (*LINK, "snr_db"), {"doppler_hz": 1.0}),
    ],
    ids=["elevation alone", "Doppler alone", "a sigma in another unit", "two Doppler shifts"],
)
def test_a_log_that_cannot_give_a_track_is_refused(tmp_path, field, names, others):
    path = written(tmp_path, ("time_s", "anchor", *names), **others)
    with refuses_log(field):
        read(path)


def test_the_nearest_radio_is_the_profile_with_the_noise_of_the_log(tmp_path):
    coarse = {"range_sigma_m": 0.9, "aoa_azimuth_sigma_deg": 4.0}
    path = written(tmp_path, ("time_s", "anchor", "toa_s", "aoa_azimuth_rad"), **coarse)
    assert nearest_radio(read(path), SCENE) == "handset"
