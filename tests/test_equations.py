"""Tests that every function and every test named in the table of docs/equations.md exists."""

import ast
import re
from functools import cache
from importlib import import_module

import pytest

from tests.paths import ROOT

PAPER = range(1, 19)  # numbers of the paper's equations
PAGE = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
CELLS = [re.split(r"(?<!\\)\|", line)[1:-1] for line in PAGE.splitlines() if line.startswith("| ")]
ROWS = [row for row in CELLS[1:] if not row[0].startswith(" **")]  # equation, words, function, test


def named(cell):
    """Return the names that are in backticks in a cell."""
    return re.findall("`([^`]+)`", cell)


FUNCTIONS = {name for row in ROWS for name in named(row[2]) if "." in name}


@cache
def functions_in(path):
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_the_table_has_a_function_and_a_test_in_every_row():
    assert len(ROWS) > 50
    for row in ROWS:
        assert len(row) == 4 and FUNCTIONS & {*named(row[2])} and named(row[3]), row


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_every_named_function_exists(name):
    """Import the longest beginning of the name that is a module, and look up the rest in it."""
    parts = name.split(".")
    for end in range(len(parts) - 1, 0, -1):
        try:
            value = import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            value = getattr(value, part)
        return
    raise ModuleNotFoundError(name)


@pytest.mark.parametrize("test", sorted({test for row in ROWS for test in named(row[3])}))
def test_every_named_test_exists(test):
    path, name = test.split("::")
    assert name.startswith("test_") and name in functions_in(path)


def test_every_equation_of_the_paper_has_a_row():
    numbered = " ".join(row[0] for row in ROWS if row[0].startswith(" paper, Sec."))
    spans = re.findall(r"\((\d+)\)(?: (?:and|to) \((\d+)\))?", numbered)
    assert {n for a, b in spans for n in range(int(a), int(b or a) + 1)} == set(PAPER)
