"""Paths of the checkout, tables of its pages, and slow cases."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LOGS = ROOT / "mmwave_env" / "data" / "logs"
RECORDINGS = ROOT / "mmwave_env" / "data" / "deepmimo_canyon28"


def numbers(text: str) -> list[float]:
    """Every number of the tables in a page or a print, in order."""
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [float(n) for row in rows for n in re.findall(r"-?\d+(?:\.\d+)?", row)]


def representative(cases, *quick):
    """All cases, those that are not named as slow: of one kind, each takes long."""
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in cases]
