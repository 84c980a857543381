"""Helpers that run ``mmwave-loc localize`` on shipped logs (a walk, a ride) or changed copies."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from experiments.console.main import run
from tests.cli import environment
from tests.paths import LOGS

WALK, RIDE = LOGS / "canyon28_pedestrian", LOGS / "canyon28_vehicle"
EPOCHS = {WALK: 400, RIDE: 120}


def options(log, *more, folder=WALK):
    return [str(v) for v in (log, "--scene", folder / "scene.json", *more)]


def figures(folder, *more, log=None, truth=True):
    """Run the command on a sample, and return the content of the JSON file that it wrote."""
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "figures.json"
        scored = ("--truth", folder / "truth.tum") if truth else ()
        words = (*scored, "--json", file, *more)
        run("localize", options(log or folder / "log.csv", *words, folder=folder))
        return json.loads(file.read_text())


def refused(capsys, arguments):
    """Check that localize refuses the arguments; return what it printed and its error line."""
    with pytest.raises(SystemExit) as stop:
        run("localize", [str(a) for a in arguments])
    assert stop.value.code == 2
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    assert line.startswith("mmwave-loc localize: ")
    return shown.out, line


def child(arguments, **more):
    words = [sys.executable, "-m", "experiments.console", "localize", *map(str, arguments)]
    return subprocess.Popen(words, env=environment(), text=True, **more)


def lines_of(name="log.csv"):
    return (WALK / name).read_text().splitlines()


def with_line(number, change):
    """Return the log of the walk with one line changed; lines are counted from 1."""
    lines = lines_of()
    lines[number - 1] = change(lines[number - 1])
    return "\n".join(lines) + "\n"


def cell(line, place, word):
    cells = line.split(",")
    cells[place] = word
    return ",".join(cells)
