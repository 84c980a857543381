"""mmwave-loc inspect: every format is told, summed up and drawn, and what is wrong is found."""

import gzip
import json
import shutil

import numpy as np
import pytest

from mmwave_env.episodes.log_folder import read_log_folder
from mmwave_env.episodes.samples import recording_from
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import LOGS, RECORDINGS, ROOT

DATA = ROOT / "mmwave_env" / "data"

VEHICLE = LOGS / "canyon28_vehicle"


def inspected(tmp_path, *words):
    """The figures of a data set, and what was printed."""
    told = succeed("inspect", *words, "--json", tmp_path / "it.json")
    return json.loads((tmp_path / "it.json").read_text()), told


def copy(tmp_path, change=lambda lines: lines, names=("log.csv", "scene.json", "truth.tum")):
    """The vehicle's log in a folder of its own, its lines changed."""
    for name in names:
        shutil.copy(VEHICLE / name, tmp_path)
    lines = (tmp_path / "log.csv").read_text().splitlines()
    (tmp_path / "log.csv").write_text("\n".join(change(lines)) + "\n")
    return tmp_path


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("canyon28_vehicle", "DeepMIMO"),
        (RECORDINGS / "canyon28_vehicle", "DeepMIMO"),
        (VEHICLE, "measurement log, CSV"),
        (VEHICLE / "log.csv", "measurement log, CSV"),
        (VEHICLE / "truth.tum", "track, TUM"),
        (RECORDINGS / "canyon28_vehicle" / "trajectory.csv", "way, CSV"),
    ],
    ids=str,
)
def test_every_format_of_one_ride_has_the_same_epochs_and_speeds(tmp_path, data, said):
    figures, told = inspected(tmp_path, data)
    recording = recording_from("canyon28_vehicle")
    steps = np.linalg.norm(np.diff(recording.position_m, axis=0), axis=1) / 0.1
    assert said in figures["format"] and said in told
    assert (figures["epochs"], figures["duration_s"]) == (120, pytest.approx(11.9))
    assert figures["step_s"] == pytest.approx(0.1) and figures["uneven_steps"] == 0
    assert figures["speed_mps"]["max"] == pytest.approx(steps.max(), abs=1e-3)
    for share, name in ((0.5, "50 %"), (0.95, "95 %")):
        expected = np.quantile(steps, share, method="inverted_cdf")
        assert figures["speed_mps"][name] == pytest.approx(expected, abs=0.011)
    assert figures["problems"] == []


@pytest.mark.parametrize("data", ["canyon28_vehicle", VEHICLE], ids=str)
def test_anchors_are_counted(tmp_path, data):
    figures, _ = inspected(tmp_path, data)
    assert [one["seen"] for one in figures["anchors"]] == [120, 111, 69]
    assert figures["line_of_sight"] == 1.0
    expected = read_log_folder(VEHICLE).scene.anchors_m
    found = [one["position_m"] for one in figures["anchors"]]
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_packed_and_column_formats_say_the_same(tmp_path):
    parquet, pyarrow = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow.csv")
    folder = copy(tmp_path)
    plain, _ = inspected(tmp_path, folder / "log.csv")
    (folder / "log.csv.gz").write_bytes(gzip.compress((folder / "log.csv").read_bytes()))
    parquet.write_table(pyarrow.read_csv(folder / "log.csv"), folder / "log.parquet")
    for name in ("log.csv.gz", "log.parquet"):
        figures, _ = inspected(tmp_path, folder / name)
        for key in ("epochs", "anchors", "speed_mps", "step_s", "problems"):
            assert figures[key] == plain[key], name


def test_a_log_without_truth_has_fixes_and_no_speeds(tmp_path):
    folder = copy(tmp_path, names=("log.csv", "scene.json"))
    figures, told = inspected(tmp_path, folder / "log.csv")
    assert figures["speed_mps"] is None and "fixes by range and angles of anchor 1" in told
    assert figures["positions"]["known"] == 120 and figures["problems"] == []


@pytest.mark.parametrize("truth", [[], ["--truth", VEHICLE / "truth.tum"]], ids=["alone", "truth"])
def test_another_scene_is_a_problem(tmp_path, truth):
    folder = copy(tmp_path, names=("log.csv",))
    figures, _ = inspected(tmp_path, folder / "log.csv", "--scene", "street", *truth)
    assert any("range_m of anchor 3" in problem for problem in figures["problems"])


def test_what_counting_finds_is_a_problem(tmp_path):
    def change(lines):
        rows = [line.split(",") for line in lines]
        for row in rows[1:]:
            if float(row[0]) > 6.0:
                row[0] = repr(float(row[0]) + 20.0)  # a gap, and no truth behind it
        rows[1][2] = ""  # a range is missing
        return [",".join(row) for row in rows if row[1] != "3"]

    figures, _ = inspected(tmp_path, copy(tmp_path, change))
    text = "\n".join(figures["problems"])
    assert figures["gaps"] == 1 and "1 gaps of more than 15 s" in text
    assert "anchor 3 was never seen" in text and "epochs without a true position" in text
    assert "1 times only some of the numbers of anchor 1" in text


def test_a_damaged_log_is_told_up_to_the_damage_and_ends_with_an_error(tmp_path):
    folder = copy(tmp_path, lambda lines: [*lines[:200], "garbage", *lines[200:]])
    done = command("inspect", folder, "--json", tmp_path / "it.json")
    assert done.returncode == 2 and "log.csv, line 201: found" in done.stderr
    figures = json.loads((tmp_path / "it.json").read_text())
    assert 0 < figures["epochs"] < 120 and "line 201" in figures["problems"][-1]


def test_a_track_that_jumps_is_a_problem(tmp_path):
    lines = (VEHICLE / "truth.tum").read_text().splitlines()
    time, _, *rest = lines[60].split()
    (tmp_path / "jumps.tum").write_text("\n".join([*lines[:60], f"{time} 900 {' '.join(rest)}"]))
    figures, _ = inspected(tmp_path, tmp_path / "jumps.tum")
    assert any("1 steps faster than" in problem for problem in figures["problems"])


@pytest.mark.parametrize("ending", [".png", ".svg"])
@pytest.mark.parametrize("data", ["canyon28_vehicle", VEHICLE / "truth.tum"], ids=str)
def test_a_data_set_is_drawn(tmp_path, data, ending):
    pytest.importorskip("matplotlib")
    succeed("inspect", data, "--plot", tmp_path / f"it{ending}")
    assert (tmp_path / f"it{ending}").stat().st_size > 5_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere: found nothing, expected a file, a folder or one of canyon28_"),
        (["README.md"], "README.md: found none of the formats known, expected the folder of a D"),
        ([VEHICLE.parent], "logs: found no log.csv, no scene.json, no truth.tum, expected a log"),
        (["canyon28_vehicle", "--plot", "it.gif"], "plot: found it.gif, expected a name that end"),
    ],
    ids=str,
)
def test_mistakes_end_with_one_clear_line(words, message):
    assert_one_clear_line(command("inspect", *words), message)


def test_a_lonely_log_asks_for_its_scene(tmp_path):
    copy(tmp_path, names=("log.csv",))
    done = command("inspect", tmp_path / "log.csv")
    assert_one_clear_line(done, "scene: found none, and no .*scene.json; expected --scene")


def test_a_recording_tells_of_its_paths(tmp_path):
    _, told = inspected(tmp_path, "canyon28_vehicle")
    assert "paths: 120 line of sight, 300 one reflection; 0 of them lead to no anchor" in told
    assert "1 base station" in told and "1 image in the ground" in told


def test_a_grid_without_a_track_is_told_too(tmp_path):
    shutil.copytree(RECORDINGS / "canyon28_vehicle", tmp_path / "grid")
    (tmp_path / "grid" / "trajectory.csv").unlink()
    figures, told = inspected(tmp_path, tmp_path / "grid")
    assert figures["timed"] is False and "users: 120 in -45 to 50.0001 m" in told
    assert "no times: mmwave-loc record" in figures["problems"][0]


def test_traffic_is_counted_by_type(tmp_path):
    figures, told = inspected(tmp_path, DATA / "traffic" / "grid.xml.gz")
    assert "trips: 35: 20 DEFAULT_VEHTYPE, 15 DEFAULT_PEDTYPE" in told
    assert figures["speed_mps"] is None and figures["problems"] == []
    shutil.copy(DATA / "traffic" / "grid.xml.gz", tmp_path)
    walkers = tmp_path / "walkers.json"
    walkers.write_text('{"fcd": "grid.xml.gz", "types": ["DEFAULT_PED*"]}')
    assert "trips: 15: 15 DEFAULT_PEDTYPE" in inspected(tmp_path, walkers)[1]


def test_a_log_of_paths_without_anchors_is_counted(tmp_path):
    simulated = ["--data", "canyon28_vehicle", "--radio", "standard", "--unassociated"]
    succeed("simulate", *simulated, "--false-paths", 5, "--out", tmp_path / "paths")
    figures, told = inspected(tmp_path, tmp_path / "paths")
    assert "without anchors" in told and figures["anchors"] == []
    assert f"paths: {120 + 111 + 69 + 5 * 120}, and 0 with" in told
    assert figures["epochs"] == 120 and figures["speed_mps"]["max"] > 9.0


def test_a_truth_with_another_clock_is_a_problem(tmp_path):
    folder = copy(tmp_path)
    lines = [line.split() for line in (folder / "truth.tum").read_text().splitlines()]
    moved = [" ".join([repr(float(t) + 0.3), *rest]) for t, *rest in lines if t != "#"]
    (folder / "truth.tum").write_text("\n".join(moved) + "\n")
    figures, _ = inspected(tmp_path, folder)
    assert any("clock" in problem for problem in figures["problems"])
