"""mmwave-loc record, as it is typed."""

import re

import numpy as np
import pytest

from mmwave_env.episodes.deepmimo import read_deepmimo
from mmwave_env.episodes.deepmimo.formats import open_scenario
from mmwave_env.episodes.deepmimo.v4_writer import write_v4
from mmwave_env.episodes.deepmimo.writer import write_deepmimo
from mmwave_env.files import write_json
from mmwave_env.models.scene import Scene, Streets, Wall, scene_json
from tests.cli import assert_one_clear_line, command, succeed
from tests.episodes.deepmimo.scenarios import VEHICLE, dynamic_twin, shortened
from tests.episodes.deepmimo.test_along import grid_paths
from tests.episodes.deepmimo.test_writer import recording


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    folder, paths = tmp_path_factory.mktemp("grid"), grid_paths()
    write_v4(folder, paths, np.arange(len(paths.position_m)), 0.0 * paths.position_m, {})
    return folder


@pytest.fixture
def way(tmp_path):
    file = tmp_path / "way.csv"
    file.write_text("t,x,y,z\n0,25,-5,1.5\n10,38,-2,1.5\n20,51,1,1.5\n")
    return file


def test_a_way_through_a_grid_becomes_a_recording(tmp_path, grid, way):
    shown = succeed("record", grid, "--along", way, "--out", tmp_path / "drive")
    users, mean, most = re.search(
        r"201 epochs from (\d+) users; measured (\S+) m from the way, at most (\S+) m", shown
    ).groups()
    assert int(users) < 50 and 0.1 < float(mean) < float(most) < 0.75
    assert "seen in 201 of 201 epochs" in shown and f"written to {tmp_path}/drive/: " in shown
    recording = read_deepmimo(tmp_path / "drive")
    assert len(recording) == 201
    between = succeed("record", grid, "--along", way, "--interpolate", "--out", tmp_path / "two")
    assert "measured 0.000 m from the way, at most 0.000 m" in between
    table = succeed("evaluate", "--data", tmp_path / "two", "--policy", "imm", "--episodes", 2)
    assert "| imm |" in table


def test_way_points_are_enough(tmp_path, grid):
    points = "x,y,z,speed_mps\n25,-5,1.5,2\n35,-5,1.5,2\n"
    (tmp_path / "points.csv").write_text(points)
    options = ("--along", tmp_path / "points.csv", "--dt", 0.5)
    assert "11 epochs from 11 users" in succeed("record", grid, *options, "--out", tmp_path / "out")


@pytest.mark.slow
def test_a_kind_of_user_moves_through_the_streets_of_a_scene(tmp_path, grid):
    streets = Streets((30.0, 60.0), (0.0, 0.0), block_m=30.0)
    scene = Scene("short", (10.0, 10.0, 10.0), (Wall((0, 1), 25.0),), streets)
    write_json(tmp_path / "scene.json", scene_json(scene))
    options = ("--along", "pedestrian", "--scene", tmp_path / "scene.json", "--dt", 1)
    shown = succeed("record", grid, *options, "--episode-steps", 30, "--out", tmp_path / "out")
    assert "30 epochs from " in shown
    assert len(read_deepmimo(tmp_path / "out")) == 30


def test_a_user_of_a_dynamic_scenario_becomes_a_recording(tmp_path):
    static = shortened(tmp_path / "static", 12)
    dynamic_twin(static, tmp_path / "dynamic", others=2)
    succeed("record", tmp_path / "dynamic", "--user", 2, "--dt", 0.1, "--out", tmp_path / "out")
    written, read = read_deepmimo(tmp_path / "out"), read_deepmimo(static, dt_s=0.1)
    np.testing.assert_allclose(written.position_m, read.position_m, atol=1e-6)
    np.testing.assert_array_equal(written.visible, read.visible)


def test_several_base_stations_stay_base_stations(tmp_path, way):
    stations = Scene("square", (0.0, 20.0, 8.0), virtual_anchors_m=((60.0, 25.0, 8.0),))
    street = grid_paths().position_m
    seen = np.ones((len(street), 2), bool)
    write_deepmimo(tmp_path / "grid", recording(stations, street, 0 * street, seen), stations=True)
    succeed("record", tmp_path / "grid", "--along", way, "--out", tmp_path / "all")
    assert len(open_scenario(tmp_path / "all").stations) == 2
    one = ("--base-station", 2, "--out", tmp_path / "one")
    shown = succeed("record", tmp_path / "grid", "--along", way, *one)
    assert "anchor at [60.0, 25.0, 8.0]: seen in 201 of 201" in shown
    assert len(open_scenario(tmp_path / "one").stations) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "along, user: found neither, expected --along"),
        (["--along", "way.csv", "--user", 0], "along, user: found both"),
        (["--along", "missing.csv"], "missing.csv: found no such file"),
        (["--along", "bicycle"], "found 'bicycle', expected one of .*cyclist"),
        (
            ["--along", "vehicle", "--scene", "o1"],
            "vehicle on o1: found .* expected a place within",
        ),
        (["--user", 1], "user: found 1 of .*canyon28_vehicle, which is static, expected --along"),
    ],
)
def test_mistakes_end_with_one_clear_line(tmp_path, options, message):
    assert_one_clear_line(command("record", VEHICLE, *options, "--out", tmp_path / "o"), message)
    assert not (tmp_path / "o").exists()


def test_a_scenario_that_is_there_is_replaced_only_if_asked(tmp_path, grid, way):
    options = ("record", grid, "--along", way, "--out", tmp_path / "out")
    succeed(*options)
    assert_one_clear_line(command(*options), "out: found a scenario in .*--overwrite replaces it")
    succeed(*options, "--overwrite")
