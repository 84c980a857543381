"""mmwave-loc raytrace: a way becomes a scenario that evaluations take."""

import json

import numpy as np
import pytest

from mmwave_env.episodes.samples import source_from
from tests.cli import assert_one_clear_line, command, succeed
from tests.episodes.raytracing.stand_in.sionna.rt import WALLS_M
from tests.episodes.raytracing.test_tracing import STAND_IN
from tests.paths import RECORDINGS


@pytest.fixture(autouse=True)
def _stand_in(monkeypatch):
    monkeypatch.syspath_prepend(STAND_IN)
    monkeypatch.setattr("mmwave_env.episodes.raytracing.tracing.version", lambda name: "2.2.0")


def test_a_way_becomes_a_scenario_that_evaluations_take(tmp_path):
    way = RECORDINGS / "canyon28_stop_and_go.csv"
    told = succeed("raytrace", "--scenario", way, "--out", tmp_path / "ride", "--dt", 0.5)
    assert told.startswith("118 epochs, 118 with a line of sight, 0 without any path; 118 x line")
    recording = source_from(tmp_path / "ride", "handset").recording
    north, south = ((-5.0, 2.0 * y - 4.0, 6.0) for y in WALLS_M)
    np.testing.assert_allclose(recording.anchors_m, [(-5.0, 4.0, 6.0), north, south], atol=1e-3)
    np.testing.assert_allclose(recording.time_s, 0.5 * np.arange(118))
    shipped = source_from("canyon28_stop_and_go", "handset").recording
    np.testing.assert_allclose(recording.position_m, shipped.position_m[::5], atol=1e-9)
    np.testing.assert_allclose(recording.velocity_mps, shipped.velocity_mps[::5], atol=1e-9)
    about = json.loads((tmp_path / "ride" / "params.json").read_text())["rt_params"]
    assert about["raytracer_name"] == "Sionna Ray Tracing"
    assert about["raw_params"] == {"geometry": "simple_street_canyon", "seed": 1}


@pytest.mark.slow  # compiles the simulation of users
def test_a_kind_of_user_is_placed_in_the_streets_of_a_scene(tmp_path):
    scene = tmp_path / "scene.json"
    street = {"x_m": [-40.0, 40.0], "y_m": [1.0, 1.0], "block_m": 40.0, "height_m": 1.2}
    scene.write_text(json.dumps({"base_station_m": [0.0, 5.0, 8.0], "carrier_hz": 60e9,
                                 "streets": street}))  # fmt: skip
    words = ("raytrace", "--scenario", "pedestrian", "--scene", scene, "--episode-steps", 40)
    ends = []
    for seed in (3, 3, 4):
        out = tmp_path / f"walk{len(ends)}"
        succeed(*words, "--seed", seed, "--out", out)
        recording = source_from(out, "handset").recording
        assert len(recording) == 40 and recording.carrier_hz == 60e9
        np.testing.assert_allclose(recording.anchors_m[0], (0.0, 5.0, 8.0))
        np.testing.assert_allclose(recording.position_m[:, 2], 1.2)
        ends.append(recording.position_m[-1].tolist())
    assert ends[0] == ends[1] != ends[2]


def test_a_scenario_that_is_there_stays_unless_told_otherwise(tmp_path):
    (tmp_path / "params.json").write_text("mine")
    words = ("raytrace", "--scenario", RECORDINGS / "canyon28_stop_and_go.csv", "--out", tmp_path)
    assert_one_clear_line(command(*words), "out: found params.json in .*; --overwrite replaces")
    assert [path.name for path in tmp_path.iterdir()] == ["params.json"]
    succeed(*words, "--dt", 5, "--overwrite")
    assert source_from(tmp_path, "handset").epochs == 12


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenario", "scooter"], "scenario: found 'scooter', expected one of pedestrian"),
        (["--scenario", "nowhere.csv"], "nowhere.csv: found no such file, expected CSV"),
        (["--scenario", "pedestrian", "--dt", "0"], "dt: found 0.0, expected a number of 1e-30"),
        (["--scenario", "WAY", "--dt", "0"], "dt: found 0, expected 0.000586.* to 58.6"),
        (["--scenario", "WAY", "--dt", "nan"], "dt: found nan, expected 0.000586"),
        (["--scenario", "WAY", "--geometry", "o1"], "geometry: found 'o1', expected one of simple"),
        (["--scenario", "jam", "--episode-steps", "1000000"], "episode_steps: found 1000000, "),
        (["--scenario", "OUT"], "OUT.csv: found no line of sight to the base station"),
        (["--scenario", "WAY", "--scene", "none.json"], "none.json: found no such file"),
    ],
)
def test_mistakes_end_with_one_clear_line(tmp_path, words, message):
    way = RECORDINGS / "canyon28_stop_and_go.csv"
    (tmp_path / "OUT.csv").write_text("t,x,y,z\n0,-5,400,1.5\n1,-5,410,1.5\n")
    given = {"WAY": way, "OUT": tmp_path / "OUT.csv"}
    words = [given.get(word, word) for word in words]
    done = command("raytrace", *words, "--out", tmp_path / "out")
    assert_one_clear_line(done, message)
    assert not (tmp_path / "out").exists()


def test_an_llvm_that_is_none_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.setenv("STAND_IN", "missing")
    way = RECORDINGS / "canyon28_stop_and_go.csv"
    done = command("raytrace", "--scenario", way, "--out", tmp_path / "out")
    assert_one_clear_line(done, "found no usable LLVM .*apt-get install libllvm19")
    assert not (tmp_path / "out").exists()
