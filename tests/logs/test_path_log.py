"""Tests of reading logs of paths, whose rows have no anchor numbers, and of refusing wrong logs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.logs.log import read_paths
from mmwave_env.logs.log_checks import MOST_PATHS
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from tests.logs import by_hand
from tests.logs.by_hand import SCENE, refuses_log

HEADER = "time_s,toa_s,aoa_azimuth_rad,aoa_elevation_rad,aod_azimuth_rad,doppler_hz,snr_db"
PATH = "1e-7,0.5,-0.1,-2.6,12.5,20"


def store(folder, *lines, header=HEADER):
    return by_hand.store(folder, "\n".join([header, *lines]) + "\n")


def delivered(path, *fields):
    """Return the numbers of paths in epochs before the damage, whose error must name fields."""
    return [*map(len, by_hand.delivered(path, *fields, reader=read_paths).epochs)]


def test_an_epoch_may_have_any_number_of_paths(tmp_path):
    lines = [f"0,{PATH}", "1,,,,,,", f"2.5,{PATH}", "2.5,2e-7,4,0.1,-4,,21", f"2.5,{PATH}"]
    log = read_paths(store(tmp_path, *lines), SCENE)
    assert log.time_s.tolist() == [0.0, 1.0, 2.5]
    assert [rows.tolist() for rows in log.epochs] == [[0], [], [2, 3, 4]]
    assert log.layout == Layout(3) and log.incomplete == 0
    first = [1e-7 * SPEED_OF_LIGHT, 0.5, -0.1, -2.6]
    second = [2e-7 * SPEED_OF_LIGHT, 4 - 2 * np.pi, 0.1, 2 * np.pi - 4]
    three = log.epochs[2]
    assert_allclose(log.links[three], [first, second, first], rtol=1e-12)
    assert log.snr_db[three].tolist() == [20, 21, 20]


def test_anchor_numbers_are_ignored(tmp_path):
    lines = [f"0,{n},{PATH}" for n in (1, 1, 99)]
    header = HEADER.replace("time_s", "time_s,anchor")
    (epoch,) = read_paths(store(tmp_path, *lines, header=header), SCENE).epochs
    assert len(epoch) == 3


def test_paths_may_lack_elevation_departure_and_an_snr_beside_deviations(tmp_path):
    header = HEADER + ",toa_sigma_s,aoa_azimuth_sigma_rad"
    usable = [
        "0,1e-7,0.5,,-2.6,12.5,20,,",
        "0,1e-7,0.5,-0.1,,,20,1e-9,",
        "0,1e-7,0.5,,,,,1e-9,0.01",
    ]
    useless = ["0,1e-7,,-0.1,-2.6,12.5,20,,", "0,1e-7,0.5,-0.1,-2.6,12.5,,1e-9,", "0,,,,,,,,"]
    log = read_paths(store(tmp_path, *usable, *useless, header=header), SCENE)
    assert [rows.tolist() for rows in log.epochs] == [[0, 1, 2]]
    sigma_m = 1e-9 * SPEED_OF_LIGHT
    stated = [
        [np.nan, np.nan, np.inf, np.nan],
        [sigma_m, np.nan, np.nan, np.inf],
        [sigma_m, 0.01, np.inf, np.inf],
    ]
    assert_allclose(log.sigma[:3], stated)
    assert log.incomplete == 2 and log.layout == Layout(3, partial=True)
    # as if the user were in the street, and the departure opposite to the arrival
    rise_m = SCENE.streets.height_m - SCENE.anchors_m[0, 2]
    assert_allclose(np.sin(log.links[0, 2]), rise_m / (100.0 * sigma_m))
    assert_allclose(log.links[1, 3], 0.5 - np.pi)


def test_paths_without_an_snr_may_get_one(tmp_path):
    path = store(tmp_path, "0,1e-7,0.5", header="time_s,toa_s,aoa_azimuth_rad")
    assert read_paths(path, SCENE, snr_db=18.0).snr_db.tolist() == [18.0]


def test_epochs_before_a_damaged_row_are_returned_before_the_error(tmp_path):
    lines = [f"0,{PATH}", f"0,{PATH}", f"1,{PATH}", "2,1e-7,0.5,x,-2.6,12.5,20"]
    epochs = delivered(store(tmp_path, *lines), "line 5, column 'aoa_elevation_rad'")
    assert epochs == [2, 1]


def test_an_epoch_with_too_many_paths_is_refused(tmp_path):
    lines = [f"0,{PATH}", *[f"1,{PATH}"] * (MOST_PATHS + 1)]
    path = store(tmp_path, *lines)
    assert len(delivered(path, f"line {MOST_PATHS + 3}, column 'time_s'")) == 1
    assert len(read_paths(store(tmp_path, *lines[:-1]), SCENE).epochs) == 2


@pytest.mark.parametrize("lines", [[], ["0,,,,,,"], ["0,1e-7,,,,,20"] * 3])
def test_a_log_without_a_complete_path_is_refused(tmp_path, lines):
    with refuses_log("log.csv"):
        read_paths(store(tmp_path, *lines), SCENE)


def test_every_usable_link_is_read_as_a_path(tmp_path):
    true = by_hand.episode(odometry=True)
    path = tmp_path / "log.csv"
    by_hand.hide_anchors(path, true)
    log = read_paths(path, SCENE)
    assert log.layout == Layout(3, odometry=True)
    assert read_paths(path, SCENE, odometry=False).layout == Layout(3)
    assert_array_equal(log.time_s, true.time_s)
    for t, rows in enumerate(log.epochs):
        links = true.measurement[t, :12].reshape(3, 4)[true.usable[t, :3]]
        order = np.argsort(links[:, 0])
        theirs = rows[np.argsort(log.links[rows, 0])]
        assert_allclose(log.links[theirs], links[order], rtol=1e-12)
        assert_array_equal(log.snr_db[theirs], true.snr_db[t, true.usable[t, :3]][order])
