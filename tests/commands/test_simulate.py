"""Tests of ``mmwave-loc simulate``, which writes the log, scene and true track of an episode."""

import re
import shlex

import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.console.main import run
from mmwave_env.datasets.log_folder import log_columns, log_text
from mmwave_env.datasets.samples import sample_names
from mmwave_env.logs.log import read_log, read_paths
from mmwave_env.logs.tum import read_tum
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import read_scene
from tests.cli import assert_refused
from tests.filters.tracks import seeded
from tests.localization.mistakes import read_columns
from tests.paths import LOGS

FILES = ["log.csv", "scene.json", "truth.tum"]


def simulate(folder, *options):
    run("simulate", [*map(str, options), "--out", str(folder)])


def test_simulate_writes_the_episode_that_evaluate_draws_with_the_same_seed(tmp_path, capsys):
    out = tmp_path / "new" / "walk"
    simulate(out, "--scenario", "pedestrian", "--seed", 7)
    assert capsys.readouterr().out == f"written to {out}/: log.csv, scene.json, truth.tum\n"
    assert sorted(path.name for path in out.iterdir()) == FILES
    episode = seeded(7, scenario="pedestrian")
    assert (out / "log.csv").read_text() == log_text(log_columns(episode))


def test_odometry_is_written_and_the_options_are_recorded_in_the_truth_file(tmp_path):
    options = ["--scenario", "jam", "--seed", "3", "--odometry", "--scene", "o1", "--radio", "high"]
    simulate(tmp_path, *options)
    block = read_log(tmp_path / "log.csv", read_scene(tmp_path / "scene.json")).whole()
    assert block.layout == Layout(3, odometry=True) and block.visible[:, -1].any()
    header, *poses = (tmp_path / "truth.tum").read_text().splitlines()
    made_by = re.fullmatch(r"# t x y z qx qy qz qw; mmwave-loc simulate (.*)", header).group(1)
    assert sorted(shlex.split(made_by)) == sorted([*options, "--out", "."])
    assert len(poses) == 200


@pytest.mark.parametrize("name", sample_names("log"))
def test_the_commands_reproduce_the_shipped_sample_logs(tmp_path, name):
    readme = (LOGS / "README.md").read_text()
    words = re.search(rf"\nmmwave-loc simulate (.*) --out {name}\n", readme).group(1)
    simulate(tmp_path, *words.split())
    ours = LOGS / name
    theirs = tmp_path
    names = sorted(path.name for path in ours.iterdir())
    assert names == sorted(path.name for path in theirs.iterdir())
    scene = read_scene(ours / "scene.json")
    again = read_scene(theirs / "scene.json")
    assert_allclose(again.anchors_m, scene.anchors_m, atol=1e-9)
    for a, b in zip(*(read_tum(folder / "truth.tum") for folder in (ours, theirs)), strict=True):
        assert_array_equal(a, b)
    # Bytes are not compared, because another libm may round the last digit differently.
    columns, again = (read_columns(folder / "log.csv") for folder in (ours, theirs))
    assert columns.keys() == again.keys()
    for name, values in columns.items():
        assert_allclose(again[name], values, rtol=1e-9, atol=1e-9)


def test_the_chosen_user_is_named_if_a_file_has_several_users(tmp_path, capsys):
    users = tmp_path / "users.csv"
    rows = [f"{t},{i},{20 + t},{y},1.5" for t in range(40) for i, y in (("a", -80), ("b", -70))]
    users.write_text("\n".join(["t,id,x,y,z", *rows]))
    simulate(tmp_path / "out", "--scenario", users, "--episode-steps", 20, "--seed", 1)
    _, line = capsys.readouterr().out.splitlines()
    user = line.removeprefix("the user is ").removesuffix(f" of {users}")
    y = read_tum(tmp_path / "out" / "truth.tum").position_m[:, 1]
    assert_allclose(y, {"a": -80.0, "b": -70.0}[user])


@pytest.mark.parametrize("name", FILES)
def test_existing_files_are_replaced_only_with_the_option_overwrite(tmp_path, name):
    (tmp_path / name).write_text("mine")
    assert_refused(f"out: found {name} .*--overwrite replaces", "simulate", "--out", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"
    simulate(tmp_path, "--overwrite")
    assert "--overwrite" not in (tmp_path / "truth.tum").read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == FILES
    assert (tmp_path / name).read_text() != "mine"


def test_a_log_of_paths_has_no_anchor_numbers_and_false_paths(tmp_path, capsys):
    for rate in (0.0, 2.0):
        simulate(tmp_path, "--paths", "--false-paths", rate, "--seed", 3, "--overwrite")
        assert "base-station.json" in capsys.readouterr().out
        scene = read_scene(tmp_path / "base-station.json")
        truth = read_scene(tmp_path / "scene.json")
        assert scene.base_station_m == truth.base_station_m and len(scene.anchors_m) == 1
        paths = read_paths(tmp_path / "log.csv", truth)
        assert "anchor" not in (tmp_path / "log.csv").read_text().splitlines()[0]
        episode = seeded(3)
        true = episode.usable[:, :3].sum()
        false = sum(map(len, paths.epochs)) - true
        assert abs(false - rate * len(episode)) <= 4.0 * (rate * len(episode)) ** 0.5


def test_paths_are_refused_with_options_that_do_not_fit(tmp_path):
    for field, *options in [
        ("measurements", "--paths", "--measurements", "range"),
        ("false_paths", "--false-paths", "2"),
        ("false-paths", "--paths", "--false-paths", "-1"),
    ]:
        assert_refused(f" {field}: ", "simulate", *options, "--out", tmp_path)
    assert not list(tmp_path.iterdir())
