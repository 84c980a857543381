"""Tests of ``mmwave-loc localize - --live``, which reads rows and writes a JSON line per epoch."""

import json

import pytest

from tests.cli import command
from tests.commands.localizing import WALK, figures, lines_of

WORDS = ("localize", "-", "--live", "--scene", WALK / "scene.json", "--radio", "standard")


def live(content, *more):
    """Run the command on bytes; return its JSON lines, lines of standard error and exit code."""
    done = command(*WORDS, *more, stdin=content)
    positions = [json.loads(line) for line in done.stdout.splitlines()]
    return positions, done.stderr.splitlines(), done.returncode


def first_rows(count):
    """Return the header and the first rows of the walk, as bytes of CSV."""
    return "\n".join(lines_of()[: count + 1]).encode() + b"\n"


def as_json(lines, whole):
    """Return CSV lines as JSON lines, each with one row or, if ``whole``, all rows of an epoch."""
    names, *rows = (line.split(",") for line in lines)
    objects = [
        {n: float(v) if v else None for n, v in zip(names, row, strict=True)} for row in rows
    ]
    if whole:
        times = dict.fromkeys(row["time_s"] for row in objects)
        objects = [{"rows": [r for r in objects if r["time_s"] == t]} for t in times]
    return "\n".join(map(json.dumps, objects)).encode()


def test_every_epoch_has_a_line_and_the_last_position_is_that_of_the_track_file(tmp_path):
    content = (WALK / "log.csv").read_bytes()
    positions, errors, code = live(content, "--speed", "1")
    # The only line of standard error is the note on what chooses the modes.
    assert code == 0 and len(positions) == 400 and len(errors) == 1
    figures(
        WALK, "--speed", "1", "--radio", "standard", "--no-smoothing", "--out", tmp_path / "t.tum"
    )
    last = [float(word) for word in (tmp_path / "t.tum").read_text().splitlines()[-1].split()]
    assert positions[-1]["position_m"] == pytest.approx(last[1:4], abs=1e-9)
    assert positions[0]["begins"] and not any(p["begins"] for p in positions[1:])


@pytest.mark.parametrize("whole", [False, True], ids=["rows", "epochs"])
def test_json_lines_give_the_same_positions_as_csv(whole):
    csv_lines, _, _ = live(first_rows(60), "--speed", "1")
    json_lines, _, code = live(as_json(lines_of()[:61], whole), "--speed", "1", "--lag", "3")
    late = [position.pop("smoothed", None) for position in json_lines]
    assert code == 0 and json_lines == csv_lines
    assert late[:3] == [None] * 3 and late[3]["time_s"] == csv_lines[0]["time_s"]


def test_damaged_and_late_rows_are_named_and_left_out():
    content = first_rows(30) + b"\x00\xff noise\n" + b"0.0,1,1e-7,0,0,0,0,20,0\n" + b"x" * 70_000
    tail = "\n".join(lines_of()[31:61]).encode()
    positions, errors, code = live(content + b"\n" + tail, "--speed", "1")
    expected, _, _ = live(first_rows(60), "--speed", "1")
    assert code == 0 and positions == expected
    assert [line.split(":")[1].strip() for line in errors[1:]] == [
        "standard input, line 32", "standard input, line 33, column 'time_s'",
        "standard input, line 34",
    ]  # fmt: skip


@pytest.mark.parametrize("content", [b"", b"\n", b"time,mood\n1,2\n", b'{"rows": 5}\n', b"[1]\n"])
def test_input_that_is_not_a_log_ends_with_one_line(content):
    positions, errors, code = live(content)
    assert not positions and code == 2 and len(errors) == 1


@pytest.mark.parametrize(
    "more",
    [("--truth", "t.tum"), ("--out", "t.tum"), ("--sample", "canyon28_vehicle"), ("--lag", "-1")],
)
def test_options_that_do_not_fit_live_are_refused(more):
    _, errors, code = live(first_rows(3), *more)
    assert code == 2 and more[0].strip("-") in errors[0].split(":")[1]
