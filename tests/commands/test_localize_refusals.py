"""Tests of ``mmwave-loc localize``: files that it must not replace, and damaged or long logs."""

import gzip
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mmwave_env.logs.tum import COLUMNS, tum_lines
from tests.cli import environment
from tests.commands.localizing import (
    RIDE,
    WALK,
    cell,
    child,
    figures,
    lines_of,
    options,
    refused,
    with_line,
)
from tests.logs.writing import read_tum

# A file that begins with this line is a track written by localize, so localize may replace it.
OLD = f"# {' '.join(COLUMNS)}; mmwave-loc localize\n"


KEPT = {  # a user's file: the value of --out that would replace it, and the message
    "trip.csv": ("trip.tum", "trip.csv, which is not a table of a track"),
    "path.tum": ("path.tum", "which is not a track of mmwave-loc localize"),  # not among the inputs
    "truth.tum": ("truth.tum", "which is also"),
    "log.csv": ("log.tum", "which is also"),
}


@pytest.mark.parametrize("name", KEPT)
def test_output_never_replaces_a_file_of_the_user(capsys, tmp_path, name):
    out, message = KEPT[name]
    for file in ("log.csv", "truth.tum", "scene.json"):
        (tmp_path / file).write_bytes((RIDE / file).read_bytes())
    if not (tmp_path / name).exists():
        (tmp_path / name).write_bytes((RIDE / "truth.tum").read_bytes())
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    more = ("--speed", "9", "--truth", tmp_path / "truth.tum", "--out", tmp_path / out)
    _, line = refused(capsys, options(tmp_path / "log.csv", *more, folder=tmp_path))
    assert message in line
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_folders_are_made_and_files_that_cannot_be_written_are_named(capsys, tmp_path):
    figures(RIDE, "--speed", "9", "--out", tmp_path / "a" / "b" / "track.tum")
    assert sorted(p.name for p in (tmp_path / "a" / "b").iterdir()) == ["track.csv", "track.tum"]
    blocked = tmp_path / "file"
    blocked.write_text("")
    capsys.readouterr()
    for option, name in (("--out", "t.tum"), ("--plot", "t.png"), ("--json", "t.json")):
        more = ("--speed", "9", option, blocked / name)
        out, line = refused(capsys, options(RIDE / "log.csv", *more, folder=RIDE))
        assert str(blocked) in line and out == ""
    (tmp_path / "a.tum").mkdir()
    _, line = refused(
        capsys, options(RIDE / "log.csv", "--speed", "9", "--out", tmp_path / "a.tum")
    )
    assert "found a folder, expected a file" in line


@pytest.mark.slow
@pytest.mark.parametrize(("unbuffered", "damaged", "code"), [("", False, 141), ("1", True, 2)])
def test_results_and_errors_are_reported_if_standard_output_is_closed(
    monkeypatch, tmp_path, unbuffered, damaged, code
):
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    log, file, (ours, theirs) = tmp_path / "log.csv", tmp_path / "figures.json", os.pipe()
    os.close(ours)
    log.write_text(with_line(602, lambda l: cell(l, 2, "far") if damaged else l))
    words = options(log, "--speed", "1", "--json", file)
    done = child(words, stdout=theirs, stderr=subprocess.PIPE)
    os.close(theirs)
    err = done.communicate(timeout=100)[1]
    assert done.returncode == code and len(err.splitlines()) == damaged
    assert ("line 602" in err) == damaged
    assert json.loads(file.read_text())["epochs"] == (200 if damaged else 400)


# --- damage

HALF_WAY = {  # line 602 is the first of epoch 201; the 200 epochs before it are complete
    "no number": (with_line(602, lambda l: cell(l, 2, "far")), "line 602, column 'toa_s'", 200),
    "at the end": (with_line(1199, lambda l: l[:20]), "line 1199: found", 399),
    "early": (with_line(6, lambda l: cell(l, 2, "far")), "line 6, column 'toa_s'", 1),
}


@pytest.mark.parametrize("zipped", [False, True], ids=["plain", "gz"])
@pytest.mark.parametrize("name", HALF_WAY)
def test_a_damaged_log_gives_the_track_up_to_the_damage(capsys, tmp_path, name, zipped):
    content, message, epochs = HALF_WAY[name]
    log, out = tmp_path / ("log.csv.gz" if zipped else "log.csv"), tmp_path / "track.tum"
    log.write_bytes(gzip.compress(content.encode()) if zipped else content.encode())
    out.write_text(OLD)
    radio = ("--radio", "handset")
    more = ("--speed", "1", "--no-smoothing", *radio, "--truth", WALK / "truth.tum", "--out", out)
    shown, line = refused(capsys, options(log, *more, "--json", tmp_path / "found.json"))
    assert message in line and str(log) in line and f"; {epochs} epochs are written" in line
    whole = tmp_path / "whole.tum"
    figures(WALK, "--speed", "1", "--no-smoothing", *radio, "--out", whole)
    assert out.read_text() == "".join(whole.read_text().splitlines(keepends=True)[: epochs + 1])
    assert len((tmp_path / "track.csv").read_text().splitlines()) == epochs + 1
    results = json.loads((tmp_path / "found.json").read_text())
    assert results["epochs"] == epochs and message in results["error"]
    assert f"{epochs} of {epochs} epochs have a true position" in shown


NOTHING = {
    "unknown column": (f"{lines_of()[0]},mood\n", "column 'mood'"),
    "first row": (with_line(2, lambda l: cell(l, 2, "x")), "line 2, column"),
    "no line of sight": (
        "\n".join(l for l in lines_of() if ",1," not in l[:7]),
        "log: found 400 epochs",
    ),
}


@pytest.mark.parametrize("name", NOTHING)
def test_a_log_that_gives_no_track_leaves_existing_files_unchanged(capsys, tmp_path, name):
    content, message = NOTHING[name]
    log, out = tmp_path / "log.csv", tmp_path / "track.tum"
    log.write_text(content)
    out.write_text(OLD)
    more = ("--speed", "1", "--out", out, "--plot", tmp_path / "a.png")
    _, line = refused(capsys, options(log, *more))
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
                "column 'speed_knots': found no known unit, expected speed_mps or speed_kmh; a",
            ],
        ),
        ("t_ms,bs,delay_ns,dist_m", ["mean time_ms", "mean anchor", "mean toa_ns", "mean range_m"]),
        ("A,B,C,D,E,F,G,H,I,J,K,L", ["column 'J': found an unknown quantity; allowed are only "]),
    ],
)
def test_all_unknown_columns_are_named_with_the_nearest_known_ones(capsys, tmp_path, header, parts):
    (tmp_path / "log.csv").write_text(f"{header}\n")
    _, line = refused(capsys, options(tmp_path / "log.csv"))
    assert not [part for part in parts if part not in line], line


def test_a_truth_without_common_times_is_refused_with_both_time_spans(capsys, tmp_path):
    truth, out = tmp_path / "truth.tum", tmp_path / "track.tum"
    truth.write_text(tum_lines(np.array([1000.0, 1002.5]), np.zeros((2, 3))))
    more = ("--speed", "1", "--truth", truth, "--out", out)
    shown, line = refused(capsys, options(WALK / "log.csv", *more))
    assert "found times from 1000.0 to 1002.5 s, expected some within 0.01 s" in line
    assert "(0.0 to 39.9 s)" in line and "; 400 epochs are written" in line
    assert len(read_tum(out).time_s) == 400 and "ATE" not in shown


# --- long logs


def long_log(path, rows):
    """Write a log that repeats the walk until it has this many rows."""
    lines = lines_of()
    rest = [line.split(",", 1)[1] for line in lines[1:]]
    with path.open("w") as file:
        file.write(f"{lines[0]}\n")
        for lap in range(rows // len(rest)):
            times = (400 * lap + np.arange(400).repeat(3)) / 10.0
            file.write("".join(f"{t},{r}\n" for t, r in zip(times.tolist(), rest, strict=True)))


# VmHWM is used because ru_maxrss of a child includes the memory of its parent.
PEAK = """
import sys
from experiments.console.main import run
run("localize", sys.argv[1:])
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs procfs")
def test_memory_does_not_grow_with_the_log(tmp_path):
    log, truth = tmp_path / "log.csv", tmp_path / "truth.tum"
    walk, peaks = read_tum(WALK / "truth.tum").position_m, []
    files = ("--out", tmp_path / "track.tum", "--plot", tmp_path / "track.png")
    more = ("--speed", "auto", "--truth", truth, *files)
    for rows in (300_000, 1_200_000):
        long_log(log, rows)
        with truth.open("w") as file:
            for lap in range(rows // 1200):
                file.write(tum_lines((400 * lap + np.arange(400)) / 10.0, walk))
        words = [sys.executable, "-c", PEAK, *options(log, *more)]
        done = subprocess.run(words, env=environment(), capture_output=True, text=True, check=True)
        assert f"{rows // 1200 * 400} epochs" in done.stdout
        peaks.append(int(done.stdout.split()[-1]) / 1024)
    assert peaks[1] < 500 and peaks[1] < peaks[0] + 18, peaks
