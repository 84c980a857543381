"""docs/equations.md: every function and every test that it names is there."""

import ast
import re
from functools import cache
from importlib import import_module

import pytest

from tests.paths import ROOT

PAGE = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
PAPER = range(1, 19)  # equations with a number
COLUMNS = ["equation or section", "in words", "function", "test"]
TABLE = [
    [cell.strip().replace(r"\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
    for line in PAGE.splitlines()
    if line.startswith("| ")
]
ROWS = [row for row in TABLE[1:] if not row[0].startswith("**")]


def in_backticks(cell):
    return re.findall("`([^`]+)`", cell)


def named(dotted):
    """Return the object of a dotted name: an attribute of the longest part that is a module."""
    parts = dotted.split(".")
    for end in range(len(parts) - 1, 0, -1):
        try:
            found = import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(dotted)


@cache
def functions_in(path):
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_the_table_has_a_function_and_a_test_in_every_row():
    assert TABLE[0] == COLUMNS and len(ROWS) > 50
    for row in ROWS:
        assert len(row) == len(COLUMNS) and all(row), row
        assert any("." in name for name in in_backticks(row[2])) and in_backticks(row[3]), row


NAMES = {name for row in ROWS for name in in_backticks(row[2]) if "." in name}


@pytest.mark.parametrize("name", sorted(NAMES))
def test_every_function_is_there(name):
    assert named(name) is not None


@pytest.mark.parametrize("test", sorted({test for row in ROWS for test in in_backticks(row[3])}))
def test_every_test_is_there(test):
    path, name = test.split("::")
    assert name.startswith("test_") and name in functions_in(path)


def test_every_equation_of_the_paper_has_a_row():
    found = set()
    for row in ROWS:
        if row[0].startswith("paper, Sec."):
            for first, last in re.findall(r"\((\d+)\)(?: (?:and|to) \((\d+)\))?", row[0]):
                found |= set(range(int(first), int(last or first) + 1))
    assert found == set(PAPER)
