"""Helpers for tests: paths in the checkout, reading and writing of files, marks for slow cases."""

import csv
import json
import re
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[1]
LOGS = ROOT / "mmwave_env" / "data" / "logs"
WALK = LOGS / "canyon28_pedestrian"
RIDE = LOGS / "canyon28_vehicle"
RECORDINGS = ROOT / "mmwave_env" / "data" / "deepmimo_canyon28"


def json_in(path):
    """Return the content of a JSON file."""
    return json.loads(path.read_text("utf-8"))


def records(path):
    """Return the rows of a CSV file as dicts by column."""
    with path.open() as file:
        return list(csv.DictReader(file))


def write_json(path, content):
    """Write a JSON file; return its path."""
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def loaded(path):
    """Run a Python file of the checkout that is not in a package; return its global variables."""
    return SimpleNamespace(**run_path(str(ROOT / path)))


def numbers(text):
    """Return all numbers in the tables of a page or of printed text, in order."""
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [float(n) for row in rows for n in re.findall(r"-?\d+(?:\.\d+)?", row)]


def representative(cases, *quick):
    """Return all cases of a test, marked as slow unless they are in ``quick``."""
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]
