"""Tests of ``mmwave-loc localize``: files that it writes, odd names and damaged logs."""

import errno
import gzip
import os
import shutil
from itertools import chain
from pathlib import Path

import gpxpy
import numpy as np
import pytest

from mmwave_env.logs.tum import COLUMNS, read_tum, tum_lines
from tests.cli import assert_printable, assert_refused, command, started, succeed
from tests.commands.localizing import RIDE, WALK, figures, lines_of, options, refused
from tests.commands.test_kills import contents
from tests.paths import json_in, write_json

SAMPLE = ("localize", "--sample", RIDE.name, "--speed", "9")


def test_a_picture_is_drawn_for_a_log_in_a_folder_with_an_odd_name(tmp_path):
    folder = tmp_path / "a$b_{^$ | \x1b[31m\n"
    shutil.copytree(RIDE, folder)
    words = ("--truth", folder / "truth.tum", "--speed", "9", "--plot", folder / "new" / "t.png")
    done = command("localize", *options(folder / "log.csv", *words, folder=folder))
    assert done.returncode == 0, done.stderr
    assert_printable(done)
    content = (folder / "new" / "t.png").read_bytes()
    assert content.startswith(b"\x89PNG") and len(content) > 20_000


def test_tracks_and_statistics_are_written_even_if_the_picture_fails(tmp_path, monkeypatch):
    def fails(*_):
        raise ValueError("no such font")

    monkeypatch.setattr("experiments.reporting.log_results.draw_trajectory", fails)
    files = ("--json", tmp_path / "t.json", "--out", tmp_path / "t.tum")
    done = command(*SAMPLE, "--plot", tmp_path / "t.png", *files)
    assert done.returncode == 2 and done.stderr == "mmwave-loc localize: no such font\n"
    assert json_in(tmp_path / "t.json")["epochs"] == 120
    assert "120 epochs" in done.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.csv", "t.json", "t.tum"]


def test_results_of_a_comparison_are_written_even_if_the_picture_fails(tmp_path, monkeypatch):
    def fails(*_):
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "e.png"))

    monkeypatch.setattr("experiments.reporting.figures.draw_error_cdf", fails)
    short = ("--policies", "fixed-ekf", "--episodes", 1, "--episode-steps", 20)
    files = ("--errors", tmp_path / "e.png", "--json", tmp_path / "e.json")
    done = command("compare", *short, *files)
    assert done.returncode == 2 and done.stderr.endswith(f"device: '{tmp_path / 'e.png'}'\n")
    assert list(json_in(tmp_path / "e.json")["policies"]) == ["fixed-ekf"]
    assert "| fixed-ekf |" in done.stdout


@pytest.fixture
def mapped(tmp_path):
    """Return a folder with the ride's log and a scene whose latitude and longitude are known."""
    scene = json_in(RIDE / "scene.json")
    scene["origin"] = {"latitude_deg": 48.0, "longitude_deg": 11.0}
    write_json(tmp_path / "scene.json", scene)
    (tmp_path / "my_ride.csv.gz").write_bytes(gzip.compress((RIDE / "log.csv").read_bytes()))
    return tmp_path


MAPPED = ("localize", "my_ride.csv.gz", "--scene", "scene.json", "--speed", "9", "--out")


def test_tracks_in_map_files_are_named_after_the_log_and_one_run_writes_several_files(mapped):
    shown = succeed(*MAPPED, "t.gpx", "t.geojson", "new/t.tum", cwd=mapped)
    (track,) = gpxpy.parse((mapped / "t.gpx").read_text()).tracks
    line = json_in(mapped / "t.geojson")["features"][0]
    assert track.name == line["properties"]["name"] == "my_ride"

    def tables():
        return [(mapped / "new" / f"t.{ending}").read_text() for ending in ("tum", "csv")]

    before = tables()
    assert "t.geojson (smoothed track), new/t.tum (smoothed track), new/t.csv (" in shown
    # naming t.csv, too, changes nothing, nor does a second track with this table
    succeed(*MAPPED, "new/t.tum", "new/t.txt", "new/t.csv", cwd=mapped)
    succeed(*MAPPED, "new/t.tum", "new/t.txt", cwd=mapped)
    assert tables() == before


@pytest.mark.parametrize("wrong", ["t.kml", "scene.json", "my_ride.csv.gz", "no_map.csv"])
def test_if_one_file_of_several_is_refused_none_is_written(mapped, wrong):
    (mapped / "no_map.csv").write_text("the only copy")
    before = contents(mapped)
    listed = ".*tum, .txt, .csv, .geojson, .gpx, .nmea" if wrong == "t.kml" else ""
    assert_refused(f"out: found {wrong}{listed}", *MAPPED, "t.gpx", "t.tum", wrong, cwd=mapped)
    assert contents(mapped) == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_an_error_while_printing_is_reported(tmp_path):
    with open("/dev/full", "w") as full:
        done = started("simulate", "--out", tmp_path, stdout=full)
        _, err = done.communicate()
    assert err == "mmwave-loc simulate: standard output: No space left on device\n"
    assert done.returncode == 2


@pytest.mark.skipif(os.name != "posix", reason="needs FIFOs")
@pytest.mark.parametrize("option", ["log", "--scene", "--truth", "--modes", "--radio"])
def test_a_fifo_is_refused_before_it_is_read(tmp_path, option):
    """Check FIFOs, because reading one can block; tests/io/test_files.py checks other odd files."""
    odd = tmp_path / ("odd.csv" if option == "log" else "odd.json")
    os.mkfifo(odd)
    files = {"log": RIDE / "log.csv", "--scene": RIDE / "scene.json", option: odd}
    log = files.pop("log")
    words = ("localize", log, *chain(*files.items()))
    assert_refused("odd.*: found a FIFO, a socket or a device, expected", *words)


def with_line(number, change):
    """Return the log of the walk with one line changed; lines are counted from 1."""
    lines = lines_of()
    lines[number - 1] = change(lines[number - 1])
    return "\n".join(lines) + "\n"


def cell(line, column, word):
    """Return a line of CSV with ``word`` in the given column; columns are counted from 0."""
    cells = line.split(",")
    cells[column] = word
    return ",".join(cells)


# A file that begins with this line is a track written by localize, so localize may replace it.
OLD = f"# {' '.join(COLUMNS)}; mmwave-loc localize\n"


def test_the_error_names_a_file_that_cannot_be_written(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    for option, name in (("--out", "t.tum"), ("--plot", "t.png"), ("--json", "t.json")):
        more = ("--speed", "9", option, blocked / name)
        out, line = refused(options(RIDE / "log.csv", *more, folder=RIDE))
        assert str(blocked) in line and out == ""


@pytest.mark.slow
@pytest.mark.parametrize(("unbuffered", "damaged", "code"), [("", False, 141), ("1", True, 2)])
def test_results_and_errors_are_reported_if_standard_output_is_closed(
    monkeypatch, tmp_path, unbuffered, damaged, code
):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    log = tmp_path / "log.csv"
    file = tmp_path / "figures.json"
    ours, theirs = os.pipe()
    os.close(ours)
    log.write_text(with_line(602, lambda l: cell(l, 2, "far") if damaged else l))
    done = started("localize", *options(log, "--speed", "1", "--json", file), stdout=theirs)
    os.close(theirs)
    err = done.communicate(timeout=100)[1]
    assert done.returncode == code and len(err.splitlines()) == damaged
    assert ("line 602" in err) == damaged
    assert json_in(file)["epochs"] == (200 if damaged else 400)


# --- damage

# name -> log, expected message, number of complete epochs. Epoch 201 begins in line 602.
DAMAGED = {
    "not a number": (with_line(602, lambda l: cell(l, 2, "far")), "line 602, column 'toa_s'", 200),
    "last row cut": (with_line(1199, lambda l: l[:20]), "line 1199: found", 399),
    "early row": (with_line(6, lambda l: cell(l, 2, "far")), "line 6, column 'toa_s'", 1),
}


@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gz"])
@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_log_gives_the_track_up_to_the_damage(tmp_path, name, zipped):
    content, message, epochs = DAMAGED[name]
    log = tmp_path / ("log.csv.gz" if zipped else "log.csv")
    out = tmp_path / "track.tum"
    log.write_bytes(gzip.compress(content.encode()) if zipped else content.encode())
    out.write_text(OLD)
    radio = ("--radio", "handset")
    more = ("--speed", "1", "--no-smoothing", *radio, "--truth", WALK / "truth.tum", "--out", out)
    shown, line = refused(options(log, *more, "--json", tmp_path / "found.json"))
    assert message in line and str(log) in line and f"; {epochs} epochs are written" in line
    whole = tmp_path / "whole.tum"
    figures(WALK, "--speed", "1", "--no-smoothing", *radio, "--out", whole)
    assert out.read_text() == "".join(whole.read_text().splitlines(keepends=True)[: epochs + 1])
    assert len((tmp_path / "track.csv").read_text().splitlines()) == epochs + 1
    results = json_in(tmp_path / "found.json")
    assert results["epochs"] == epochs and message in results["error"]
    assert list(results["truth"]["tracks"]) == ["filtered"]
    assert f"{epochs} of {epochs} epochs have a true position" in shown


NO_TRACK = {  # name -> log, expected message
    "unknown column": (f"{lines_of()[0]},mood\n", "column 'mood'"),
    "first row": (with_line(2, lambda l: cell(l, 2, "x")), "line 2, column"),
    "one range": (
        "\n".join(
            ["time_s,anchor,range_m,snr_db", *(f"{t},1,{80 + t % 7},20" for t in range(400))]
        ),
        "log: found 400 epochs",
    ),
}


@pytest.mark.parametrize("name", NO_TRACK)
def test_a_log_that_gives_no_track_leaves_existing_files_unchanged(tmp_path, name):
    content, message = NO_TRACK[name]
    log = tmp_path / "log.csv"
    out = tmp_path / "track.tum"
    log.write_text(content)
    out.write_text(OLD)
    _, line = refused(options(log, "--speed", "1", "--out", out, "--plot", tmp_path / "a.png"))
    assert message in line and "written" not in line and out.read_text() == OLD
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log.csv", "track.tum"]


@pytest.mark.parametrize(
    ("header", "parts"),
    [
        (
            "time_s,anchor,range_yd,azimuth_deg_compass,mood,speed_knots",
            [
                "column 'range_yd': found no known unit, expected toa_s, ",
                ", range_m or range_ft; column 'azimuth_deg_compass'",
                "(did you mean aoa_azimuth_rad or aoa_azimuth_deg, the azimuth from",
                "column 'speed_knots': found no known unit, expected speed_mps or speed_kmh; the",
            ],
        ),
        ("t_ms,bs,delay_ns,dist_m", ["mean time_ms", "mean anchor", "mean toa_ns", "mean range_m"]),
        ("A,B,C,D,E,F,G,H,I,J,K,L", ["column 'J': found an unknown quantity; the only allowed "]),
    ],
)
def test_the_error_names_all_unknown_columns_and_similar_known_columns(tmp_path, header, parts):
    (tmp_path / "log.csv").write_text(f"{header}\n")
    _, line = refused(options(tmp_path / "log.csv"))
    assert not [part for part in parts if part not in line], line


def test_if_log_and_truth_do_not_overlap_in_time_the_error_shows_both_time_spans(tmp_path):
    truth = tmp_path / "truth.tum"
    out = tmp_path / "track.tum"
    truth.write_text(tum_lines(np.array([1000.0, 1002.5]), np.zeros((2, 3))))
    more = ("--speed", "1", "--truth", truth, "--out", out)
    shown, line = refused(options(WALK / "log.csv", *more))
    assert "those of this file 1000 to 1002.5 s" in line
    assert "the log's times are 0 to 39.9 s" in line and "; 400 epochs are written" in line
    assert len(read_tum(out).time_s) == 400 and "ATE" not in shown
