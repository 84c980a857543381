"""Helpers that run ``mmwave-loc localize`` on shipped logs (a walk, a ride) or on other logs."""

import tempfile
from pathlib import Path

from experiments.console.main import run
from tests.cli import command
from tests.paths import LOGS, RIDE, ROOT, WALK, json_in

STREET = LOGS / "street_paths"
EPOCHS = {WALK: 400, RIDE: 120}  # number of epochs in each log


def options(log, *more, folder=WALK):
    """Return the words after ``localize``: the log, the folder's scene, and more options."""
    return [str(v) for v in (log, "--scene", folder / "scene.json", *more)]


def figures(folder, *more, log=None, truth=True):
    """Run the command on ``log`` or on the folder's log; return the content of its JSON file.

    ``truth`` says whether the track is compared with the folder's true track.
    """
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "figures.json"
        scored = ("--truth", folder / "truth.tum") if truth else ()
        words = (*scored, "--json", file, *more)
        run("localize", options(log or folder / "log.csv", *words, folder=folder))
        return json_in(file)


def refused(arguments, cwd=ROOT):
    """Check that the command refuses the arguments; return its output and its error line."""
    done = command("localize", *arguments, cwd=cwd)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("mmwave-loc localize: ")
    return done.stdout, line


def lines_of():
    """Return the lines of the walk's log."""
    return (WALK / "log.csv").read_text().splitlines()
