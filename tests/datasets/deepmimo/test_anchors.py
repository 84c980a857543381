"""Tests of anchors found from paths: base stations and their mirror images in walls."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.deepmimo import read_deepmimo
from mmwave_env.datasets.deepmimo.anchors import find_links
from mmwave_env.datasets.deepmimo.v4 import open_scenario
from tests.datasets.deepmimo.scenarios import (
    LINK,
    OF_PATHS,
    PEDESTRIAN,
    assert_fits,
    edit,
    load,
    reflect,
    set_at,
    shortened,
    store,
    write_hall,
)
from tests.refusals import refuses

# links of the second and the third base station
OTHERS = ("t000_tx001_r001", "t002_tx000_r001")
STATIONS = np.array([[0.0, 0.0, 8.0], [60.0, 5.0, 10.0], [20.0, -25.0, 6.0]])
WALL = (np.array([0.0, -1.0, 0.0]), 30.0)  # normal and offset of the plane y = -30
USERS = np.column_stack([np.linspace(5.0, 55.0, 26), np.full(26, -8.0), np.full(26, 1.5)])


def hide_line_of_sight(folder, link, epochs):
    edit(folder, "inter", set_at((epochs, 0), np.nan), link)


@pytest.fixture
def three_stations(tmp_path):
    for link, station in zip((LINK, *OTHERS), STATIONS, strict=True):
        write_hall(tmp_path, station, USERS, [WALL], link)
    hide_line_of_sight(tmp_path, LINK, slice(0, 9))
    hide_line_of_sight(tmp_path, OTHERS[1], slice(0, 4))
    return tmp_path


def test_several_stations_are_anchors_sorted_by_how_often_they_are_visible(three_stations):
    recording = read_deepmimo(three_stations)
    assert_allclose(recording.anchors_m, STATIONS[[1, 2, 0]], atol=1e-6)
    assert recording.visible.sum(axis=0).tolist() == [26, 22, 17, 26]
    assert_fits(recording, recording.scene)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_chosen_station_has_its_mirror_images_as_anchors(three_stations, number):
    recording = read_deepmimo(three_stations, base_station=number)
    station = STATIONS[number - 1]
    assert_allclose(recording.anchors_m, [station, reflect(station, *WALL)], atol=1e-6)
    assert recording.visible[:, 1].all()


@pytest.mark.parametrize("number", [0, 4, -1])
def test_a_station_that_does_not_exist_is_refused(three_stations, number):
    with refuses("base_station"):
        read_deepmimo(three_stations, base_station=number)


def test_a_station_that_is_never_visible_is_not_an_anchor(three_stations):
    hide_line_of_sight(three_stations, LINK, slice(None))
    assert len(read_deepmimo(three_stations).anchors_m) == 2
    for link in OTHERS:
        hide_line_of_sight(three_stations, link, slice(None))
    with refuses("inter"):
        read_deepmimo(three_stations)


@settings(max_examples=25)
@given(lean=st.floats(-0.3, 0.3), turn=st.floats(0.0, 2.0 * np.pi))
def test_sloping_ground_and_leaning_walls_are_told_apart(tmp_path_factory, lean, turn):
    folder = tmp_path_factory.mktemp("slope")
    side = np.array([np.cos(turn), np.sin(turn), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    ground = -up + lean * side
    wall = side + lean * up
    surfaces = []
    for normal in (ground / np.linalg.norm(ground), wall / np.linalg.norm(wall)):
        points = np.vstack([USERS, STATIONS[:1]])
        surfaces.append((normal, float((points @ normal).max()) + 2.0))
    write_hall(folder, STATIONS[0], USERS, surfaces)
    scenario = open_scenario(folder)
    (station,) = scenario.paths(scenario.epochs(None))
    links = find_links(station, USERS)
    images = [reflect(STATIONS[0], *surface) for surface in surfaces]
    assert_allclose(links.anchors_m[1:], images, atol=1e-4)
    assert links.is_ground.tolist() == [False, True, False]


def test_paths_with_two_reflections_are_left_out_whatever_their_values(tmp_path):
    folder = shortened(tmp_path / "walk", 20, source=PEDESTRIAN)
    expected = read_deepmimo(folder)
    for key in OF_PATHS:
        array = load(folder, key)
        twice = np.full_like(array, 11.0 if key == "inter" else np.nan)
        if key != "inter":
            twice[::2] = 1e30
        store(folder, key, np.concatenate([array, twice], axis=1))
    recording = read_deepmimo(folder)
    assert_array_equal(recording.measurement, expected.measurement)
    assert_array_equal(recording.visible, expected.visible)


MISTAKES = {
    "delay": lambda a: 1e9 * a,
    "aoa_az": lambda a: 90.0 - a,
    "aoa_el": lambda a: 90.0 - a,
    "power": lambda a: 10.0 ** (a / 10.0),
}


@pytest.mark.parametrize("key", MISTAKES)
def test_a_mistake_in_a_unit_or_a_convention_is_refused(tmp_path, key):
    folder = shortened(tmp_path / "walk", 30)
    edit(folder, key, MISTAKES[key])
    with refuses(folder, key):
        read_deepmimo(folder)
