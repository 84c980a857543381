"""Tests of logs that lack quantities or state their own noise."""

import csv

import numpy as np
import pytest

from mmwave_env.localization.radio_choice import nearest_radio
from mmwave_env.logs.log import read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.scene import read_scene
from tests.paths import LOGS
from tests.refusals import refuses

WALK = LOGS / "canyon28_pedestrian"
SCENE = read_scene(WALK / "scene.json")
LINK = ("toa_s", "aoa_azimuth_rad", "aoa_elevation_rad", "aod_azimuth_rad")


def written(path, columns, change=lambda row: row, **more):
    """Write the walk with only some columns, changed rows, and additional constant columns."""
    with (WALK / "log.csv").open() as walk, path.open("w", newline="") as file:
        table = csv.DictWriter(file, [*columns, *more], extrasaction="ignore")
        table.writeheader()
        for row in csv.DictReader(walk):
            table.writerow(change(row) | more)
    return path


def read(path, **options):
    return next(read_log(path, SCENE, partial=True, **options))


def test_a_link_that_lacks_one_number_is_used_with_its_other_numbers(tmp_path):
    def spoil(row):
        return row | {LINK[int(row["anchor"]) % 4]: ""}

    columns = ("time_s", "anchor", *LINK, "doppler_hz", "snr_db")
    block = read(written(tmp_path / "log.csv", columns, spoil))
    whole = read(WALK / "log.csv")
    np.testing.assert_array_equal(block.visible, whole.visible)
    measured, before = np.isfinite(block.measurement), np.isfinite(whole.measurement)
    assert (measured.sum(axis=0) == before.sum(axis=0) * (measured.any(axis=0))).all()
    assert (~measured.any(axis=0)).sum() == 3  # one quantity of each link is always missing


def test_standard_deviations_in_a_log_are_used_and_make_an_snr_unnecessary(tmp_path):
    names = {"toa_sigma_ns": 2.0, "aoa_azimuth_sigma_deg": 1.0, "doppler_sigma_mps": 0.5}
    columns = ("time_s", "anchor", "toa_s", "aoa_azimuth_rad", "doppler_hz")
    block = read(written(tmp_path / "log.csv", columns, **names))
    expected = (2e-9 * SPEED_OF_LIGHT, np.radians(1.0), 0.5 * SCENE.hz_per_mps)
    for row, value in zip((0, 1, block.layout.doppler), expected, strict=True):
        sigma = block.sigma[:, row]
        np.testing.assert_allclose(sigma[np.isfinite(sigma)], value, rtol=1e-12)
    assert np.isnan(block.sigma[:, 2]).all() and not np.isfinite(block.snr_db).any()


def test_a_log_without_noise_columns_is_refused_unless_an_snr_is_given(tmp_path):
    path = written(tmp_path / "log.csv", ("time_s", "anchor", "toa_s", "aoa_azimuth_rad"))
    with refuses("columns", error=LogError):
        read(path)
    assert read(path, snr_db=15.0).visible.any()


def both(row):
    return row | {"doppler_hz": 1.0}


@pytest.mark.parametrize(
    ("field", "columns", "change", "more"),
    [
        ("columns", ("time_s", "anchor", "aoa_elevation_rad", "snr_db"), dict, {}),
        ("columns", ("time_s", "anchor", "doppler_hz", "snr_db"), dict, {}),
        ("range_sigma_m", ("time_s", "anchor", "toa_s"), dict, {"range_sigma_m": 0.0}),
        ("range_sigma_m", ("time_s", "anchor", "toa_s"), dict, {"range_sigma_m": -1.0}),
        ("doppler_hz", ("time_s", "anchor", *LINK, "doppler_hz", "snr_db"), both, {}),
    ],
    ids=["elevation alone", "Doppler alone", "zero sigma", "negative sigma", "two Doppler shifts"],
)
def test_a_log_that_cannot_give_a_track_is_refused(tmp_path, field, columns, change, more):
    path = written(tmp_path / "log.csv", columns, change, **more)
    with refuses(field, error=LogError):
        read(path)


def test_the_nearest_radio_is_the_profile_with_the_noise_of_the_log(tmp_path):
    assert nearest_radio(read(WALK / "log.csv"), SCENE) == "standard"  # the radio of the log
    coarse = {"range_sigma_m": 0.9, "aoa_azimuth_sigma_deg": 4.0}
    path = written(tmp_path / "log.csv", ("time_s", "anchor", "toa_s", "aoa_azimuth_rad"), **coarse)
    assert nearest_radio(read(path), SCENE) == "handset"
