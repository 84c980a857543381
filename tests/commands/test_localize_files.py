"""Tests of ``mmwave-loc localize`` with FIFOs, full disks, pictures that fail and odd names."""

import errno
import gzip
import json
import os
import shutil
import subprocess
import sys
from itertools import chain
from pathlib import Path

import gpxpy
import pytest

from tests.cli import assert_one_clear_line, command, environment, succeed
from tests.commands.localizing import RIDE, options
from tests.paths import ROOT

SAMPLE = ("localize", "--sample", RIDE.name, "--speed", "9")


def test_a_picture_is_drawn_with_and_without_a_truth_for_any_name(tmp_path):
    folder = tmp_path / "a$b_{^$ | \x1b[31m\n"
    shutil.copytree(RIDE, folder)
    for name, truth in {"new/t.png": ("--truth", folder / "truth.tum"), "plain.png": ()}.items():
        path = folder / name
        words = options(folder / "log.csv", *truth, "--plot", path, folder=folder)
        done = command("localize", *words)
        assert done.returncode == 0, done.stderr
        assert all(line.isprintable() for line in (done.stdout + done.stderr).splitlines())
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG") and len(content) > 20_000


def test_files_and_figures_are_written_even_if_the_picture_fails(tmp_path, monkeypatch):
    def fails(*_):
        raise ValueError("no such font")

    monkeypatch.setattr("experiments.reporting.log_results.draw_trajectory", fails)
    files = ("--json", tmp_path / "t.json", "--out", tmp_path / "t.tum")
    done = command(*SAMPLE, "--plot", tmp_path / "t.png", *files)
    assert done.returncode == 2 and done.stderr == "mmwave-loc localize: no such font\n"
    assert json.loads((tmp_path / "t.json").read_text())["epochs"] == 120
    assert "120 epochs" in done.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.csv", "t.json", "t.tum"]


def test_results_of_a_comparison_are_written_even_if_the_picture_fails(tmp_path, monkeypatch):
    def fails(*_):
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "e.png"))

    monkeypatch.setattr("experiments.reporting.comparison_results.draw_error_cdf", fails)
    short = ("--policies", "fixed-ekf", "--episodes", 1, "--episode-steps", 20)
    files = ("--errors", tmp_path / "e.png", "--json", tmp_path / "e.json")
    done = command("compare", *short, *files)
    assert done.returncode == 2 and done.stderr.endswith(f"device: '{tmp_path / 'e.png'}'\n")
    assert list(json.loads((tmp_path / "e.json").read_text())["policies"]) == ["fixed-ekf"]
    assert "| fixed-ekf |" in done.stdout


@pytest.fixture
def mapped(tmp_path):
    """Return a folder with the ride's log (my_ride.csv.gz) and a scene with a known latitude."""
    scene = json.loads((RIDE / "scene.json").read_text())
    scene["origin"] = {"latitude_deg": 48.0, "longitude_deg": 11.0}
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    (tmp_path / "my_ride.csv.gz").write_bytes(gzip.compress((RIDE / "log.csv").read_bytes()))
    return tmp_path


MAPPED = ("localize", "my_ride.csv.gz", "--scene", "scene.json", "--speed", "9", "--out")


def test_one_run_writes_several_files_and_the_track_in_maps_has_the_name_of_the_log(mapped):
    shown = succeed(*MAPPED, "t.gpx", "t.geojson", "new/t.tum", cwd=mapped)
    (track,) = gpxpy.parse((mapped / "t.gpx").read_text()).tracks
    line = json.loads((mapped / "t.geojson").read_text())["features"][0]
    assert track.name == line["properties"]["name"] == "my_ride"
    tables = [(mapped / "new" / f"t.{ending}").read_text() for ending in ("tum", "csv")]
    assert "t.geojson (smoothed track), new/t.tum (smoothed track), new/t.csv (its" in shown
    succeed(*MAPPED, "new/t.tum", "new/t.csv", cwd=mapped)  # the table may be named, too
    assert [(mapped / "new" / f"t.{ending}").read_text() for ending in ("tum", "csv")] == tables


@pytest.mark.parametrize("wrong", ["t.kml", "scene.json", "my_ride.csv.gz", "no_map.csv"])
def test_if_one_file_of_several_is_refused_none_is_written(mapped, wrong):
    (mapped / "no_map.csv").write_text("the only copy")
    before = {path: path.read_bytes() for path in mapped.iterdir()}
    done = command(*MAPPED, "t.gpx", "t.tum", wrong, cwd=mapped)
    assert_one_clear_line(done, f"out: found {wrong}")
    if wrong == "t.kml":
        assert "ends with .tum, .txt, .csv, .geojson, .gpx, .nmea" in done.stderr
    assert {path: path.read_bytes() for path in mapped.iterdir()} == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_an_error_while_printing_is_reported():
    with open("/dev/full", "w") as full:
        words = [sys.executable, "-m", "experiments.console", "list"]
        pipes = {"stdout": full, "stderr": subprocess.PIPE, "text": True}
        done = subprocess.run(words, env=environment(), cwd=ROOT, **pipes)
    assert done.stderr == "mmwave-loc list: standard output: No space left on device\n"
    assert done.returncode == 2


@pytest.mark.skipif(os.name != "posix", reason="needs FIFOs")
@pytest.mark.parametrize("option", ["log", "--scene", "--truth", "--modes", "--radio"])
def test_a_fifo_is_refused_before_it_is_read(tmp_path, option):
    """Use FIFOs, as reading one never ends; tests/io/test_files.py uses other special files."""
    odd = tmp_path / ("odd.csv" if option == "log" else "odd.json")
    os.mkfifo(odd)
    files = {"log": RIDE / "log.csv", "--scene": RIDE / "scene.json", option: odd}
    log = files.pop("log")
    done = command("localize", log, *chain(*files.items()), "--speed", "9")
    assert_one_clear_line(done, "odd.*: found a FIFO, expected")


@pytest.mark.parametrize("name", ["e\x1b]0;owned\x07", "x" * 81, 7])
@pytest.mark.parametrize("kind", ["modes", "scene"])
def test_an_invalid_name_is_refused_with_its_file_and_key(tmp_path, kind, name):
    content = {
        "modes": {"modes": [{"name": name}]},
        "scene": {"name": name, "base_station_m": [0.0, 0.0, 10.0]},
    }[kind]
    path = tmp_path / f"{kind}.json"
    path.write_text(json.dumps(content))
    scene = path if kind == "scene" else RIDE / "scene.json"
    more = ("--modes", path) if kind == "modes" else ()
    done = command("localize", RIDE / "log.csv", "--scene", scene, "--speed", "9", *more)
    assert_one_clear_line(
        done, f"{kind}.json: .*name.*: found .*expected 1 to 80 printable characters"
    )
    assert len(done.stderr) < 1000
