from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from mmwave_env.episodes.deepmimo import read_deepmimo
from mmwave_env.episodes.deepmimo.formats import open_scenario
from mmwave_env.episodes.deepmimo.v3_files import read_channels, read_locations
from mmwave_env.episodes.deepmimo.writer import paths_of
from mmwave_env.episodes.samples import recording_from, source_from
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from tests.episodes.deepmimo.v3_folder import (
    cells,
    write_dynamic,
    write_params,
    write_static,
    write_users,
)
from tests.paths import RECORDINGS


def traced(name):
    """The paths of a recording that comes with the package, as they were traced."""
    scenario = open_scenario(RECORDINGS / name)
    return scenario.paths(scenario.epochs(None))


def sidecar(name, folder):
    (folder / "trajectory.csv").write_bytes((RECORDINGS / name / "trajectory.csv").read_bytes())


def assert_same(one, two, atol=1e-4):
    """The same track and the same links."""
    assert one.layout == two.layout and one.carrier_hz == two.carrier_hz
    np.testing.assert_allclose(one.time_s, two.time_s, atol=1e-9)
    np.testing.assert_allclose(one.position_m, two.position_m, atol=1e-9)
    np.testing.assert_allclose(one.anchors_m, two.anchors_m, atol=1e-3)
    np.testing.assert_array_equal(one.visible, two.visible)
    rows = np.repeat(one.visible, [4] * one.layout.anchors + [1], axis=1)
    np.testing.assert_allclose(one.measurement[rows], two.measurement[rows], atol=atol)
    seen = one.visible[:, :-1]
    np.testing.assert_allclose(one.path_gain_db[seen], two.path_gain_db[seen], atol=1e-5)


@pytest.mark.parametrize("name", ["canyon28_vehicle", "canyon28_pedestrian"])
def test_reflections_are_found_from_delays_and_directions(tmp_path, name):
    write_static(tmp_path, traced(name), doppler=True)
    sidecar(name, tmp_path)
    assert_same(read_deepmimo(tmp_path), recording_from(name))
    assert_same(source_from(tmp_path, "handset").recording, recording_from(name))
    ground = read_deepmimo(RECORDINGS / name, virtual_anchors=3, ground=True)
    assert_same(read_deepmimo(tmp_path, virtual_anchors=3, ground=True), ground, atol=2e-4)


def test_scenes_of_a_dynamic_scenario_are_the_epochs(tmp_path):
    write_dynamic(tmp_path, traced("canyon28_vehicle"), tx_loc=False)
    dynamic = read_deepmimo(tmp_path, users=1, dt_s=0.1)
    assert_same(dynamic, read_deepmimo(RECORDINGS / "canyon28_vehicle", dt_s=0.1), atol=1e-2)


def test_base_stations_are_those_of_the_files(tmp_path):
    recorded = recording_from("canyon28_vehicle")
    in_view = recorded.visible[:, :3].all(axis=1)
    first = int(np.argmax(in_view))
    window = recorded.window(first, int(np.argmin(in_view[first:])))
    write_static(tmp_path, paths_of(window, stations=True)[0])
    read = read_deepmimo(tmp_path, dt_s=0.1)
    np.testing.assert_allclose(read.anchors_m, recorded.anchors_m, atol=1e-6)
    assert read.visible.all()
    second = read_deepmimo(tmp_path, dt_s=0.1, base_station=2)
    np.testing.assert_allclose(second.anchors_m, recorded.anchors_m[1:2], atol=1e-6)
    with pytest.raises(ValueError, match="base_station: found 4, expected 1 to 3: BS1, BS2, BS3"):
        read_deepmimo(tmp_path, dt_s=0.1, base_station=4)


def test_only_files_with_the_users_are_read(tmp_path):
    paths = traced("canyon28_vehicle")
    write_static(tmp_path, paths, a_file=40)
    (tmp_path / "BS1_UE_40-80.mat").write_bytes(b"damaged")
    users = np.arange(119, 80, -1)
    read = read_deepmimo(tmp_path, users=users, dt_s=0.1)
    np.testing.assert_array_equal(read.position_m, paths.position_m[users])
    with pytest.raises(ValueError, match="BS1_UE_40-80.mat"):
        read_deepmimo(tmp_path, users=[38, 39, 40, 41], dt_s=0.1)


def test_paths_that_are_no_reflection_in_a_wall_are_left_out(tmp_path):
    """Two bounces between parallel walls have an image, too; a diffraction has one a user."""
    paths = traced("canyon28_vehicle")
    (station,) = paths.stations
    g, p = station.position_m, paths.position_m
    corner = np.array([-20.0, 9.0, 3.0])
    twice = g + np.array([0.0, 40.0, 0.0])  # mirrored in one wall, then in the one across
    ways = {  # where it seems to come from, where it leaves for, its length
        "diffracted": (
            corner - p, np.tile(corner - g, (len(p), 1)),
            np.linalg.norm(corner - p, axis=1) + np.linalg.norm(corner - g),
        ),
        "twice": (twice - p, p - twice, np.linalg.norm(twice - p, axis=1)),
    }  # fmt: skip

    def angles(way):
        azimuth = np.arctan2(way[:, 1], way[:, 0])
        return np.stack([azimuth, np.arctan2(np.hypot(*way[:, :2].T), way[:, 2])], axis=-1)

    def add(array, column):
        return np.concatenate([array, column[:, None]], axis=1)

    for arrival, departure, length in ways.values():
        station = replace(
            station,
            interactions=add(station.interactions, np.full(len(p), 2.0)),
            bounce_m=add(station.bounce_m, np.full((len(p), 3), np.nan)),
            gain_db=add(station.gain_db, np.full(len(p), -80.0)),
            delay_s=add(station.delay_s, length / SPEED_OF_LIGHT),
            arrival=add(station.arrival, angles(arrival)),
            departure=add(station.departure, angles(departure)),
        )
    write_static(tmp_path, replace(paths, stations=(station,)))
    read = read_deepmimo(tmp_path, virtual_anchors=20, dt_s=0.1)
    known = read_deepmimo(RECORDINGS / "canyon28_vehicle", virtual_anchors=20, dt_s=0.1)
    assert_same(read, known, atol=1e-2)
    kinds = open_scenario(tmp_path).paths(open_scenario(tmp_path).epochs(None)).stations[0].kinds()
    assert kinds["other"] >= 2 * len(p)


# --- damage


@pytest.fixture
def folder(tmp_path):
    """A small scenario, to damage."""
    write_static(tmp_path, traced("canyon28_vehicle"), a_file=60)
    return tmp_path


def users_file(rows=None, count=60, **changes):
    """What a file of users holds."""
    rows = np.array([[0, 1e-7, -60, 5, 90, -175, 90, 1]], float).T if rows is None else rows
    places = np.column_stack([np.arange(count), np.zeros(count), np.ones(count)])
    content = {"channels": cells([{"p": rows}] * count), "rx_locs": places,
               "tx_loc": np.array([[-30.0, 0.0, 1.0]])}  # fmt: skip
    return {name: value for name, value in (content | changes).items() if value is not None}


NOTHING = np.empty((8, 0))
BAD = np.array([[0, 1e-7, -60, 5, 90, -175, np.nan, 1]]).T


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (users_file(channels=None), "variables: found no channels or channels_VV"),
        (users_file(rx_locs=None), "variables: found no rx_locs"),
        (users_file(rx_locs=np.zeros((50, 5))), r"rx_locs: found shape \(50, 5\), .*\(60, 5\)"),
        (users_file(rx_locs=np.zeros((60, 2))), r"rx_locs: found shape \(60, 2\), expected shape"),
        (
            users_file(rx_locs=np.full((60, 5), np.nan)),
            "rx_locs, row 1: found .nan.*x, y, z",
        ),
        (users_file(tx_loc=np.zeros((1, 2))), "tx_loc, rx_locs: found .0.0, 0.0. for BS1"),
        (users_file(tx_loc=None), r"BS1_BS.mat: found no such file"),
        (
            users_file(channels=np.zeros(60)),
            "channels.1..p: .* .1 entries of numbers",
        ),
        (users_file(channels=cells([{"p": "text"}] * 60)), "found no readable array .char"),
        (users_file(channels=cells([{"q": 1.0}] * 60)), "found no readable array .only q, no f"),
        (
            users_file(rows=np.zeros((7, 2))),
            r"p: found shape \(7, 2\), expected 8 or 10",
        ),
        (users_file(rows=np.zeros((8, 1001))), "expected 8 or 10 rows, at most 1000 paths"),
        (users_file(rows=BAD), r"channels.1..p\(7, 1\), DoD_theta: found nan, expected a finite"),
        (users_file(rows=1j * BAD), "found no readable array .complex numbers"),
        (
            users_file(channels=cells([{"p": np.empty((8, 0))}] * 50)),
            "50 entries of cell, no cell 51",
        ),
    ],
)
def test_files_that_hold_something_else_are_refused(folder, content, message):
    savemat(folder / "BS1_UE_0-60.mat", content)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as raised:
        read_deepmimo(folder, users=np.arange(55), dt_s=0.1)
    assert str(folder) in str(raised.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"transmit_power": 0.0}, "params.mat: variables: found no carrier_freq"),
        ({"carrier_freq": 28e9}, "params.mat: variables: found no transmit_power"),
        (
            {"carrier_freq": -1.0, "transmit_power": 0.0},
            "carrier_freq: found -1.0, expected",
        ),
        ({"carrier_freq": [1, 2], "transmit_power": 0.0}, "carrier_freq: found 2 values"),
        ({"carrier_freq": 28e9, "transmit_power": np.nan}, "transmit_power: found nan"),
    ],
)
def test_parameters_that_are_missing_or_wrong_are_refused(folder, content, message):
    savemat(folder / "params.mat", content)
    with pytest.raises(ValueError, match=message):
        read_deepmimo(folder, dt_s=0.1)


def test_files_of_matlab_7_3_and_other_files_are_refused(folder):
    file = folder / "BS1_UE_0-60.mat"
    for content, message in (
        (b"MATLAB 7.3 MAT-file" + bytes(600), "HDF5 of MATLAB 7.3: save it with the option -v7"),
        (b"text", "no file of MATLAB 5 to 7"),
        (b"", "no file of MATLAB 5 to 7"),
        (file.read_bytes()[:1000], "BS1_UE_0-60.mat"),
    ):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_deepmimo(folder, dt_s=0.1)


def test_a_scenario_without_users_or_with_other_stations_in_a_scene_is_refused(tmp_path):
    write_params(tmp_path, 28e9)
    with pytest.raises(ValueError, match="found those of no base station, expected those of one"):
        read_deepmimo(tmp_path)
    paths = traced("canyon28_vehicle")
    write_users(tmp_path / "scene_0", paths, 0, 1, [0])
    (tmp_path / "scene_10").mkdir()
    with pytest.raises(ValueError, match="scene_10: .*found those of no base station.*BS1"):
        read_deepmimo(tmp_path)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_random_damage_is_refused_or_harmless(tmp_path_factory, data):
    """Neither another error, nor more memory than the file has."""
    file = tmp_path_factory.getbasetemp() / "BS1_UE_0-3.mat"
    savemat(file, users_file(count=3))
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    for read in (lambda: read_channels(file, np.arange(3)), lambda: read_locations(file, 3)):
        assert file.name in message_of(read)


def message_of(read):
    """What is said about a file that is refused."""
    try:
        read()
    except ValueError as error:
        return str(error)
    return "BS1_UE_0-3.mat is as good as before"
