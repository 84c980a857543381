"""Tests of the wording of docstrings and names."""

import ast
from functools import cache

from tests.paths import ROOT

SOURCE = ("mmwave_env", "policies", "experiments", "examples", "docs/site")
NO_SUBJECT = {"What", "How", "Where", "Who", "Of", "As", "By"}
VAGUE = {"found", "one", "told", "seen", "what", "there", "given"}
EXCEPTIONS = {  # "PATH: NAME" of names that users type or that files contain
    "mmwave_env/localization/contradictions.py: found",
}
MOST_IN_TESTS = 10  # maximum number of vague names


@cache
def modules():
    """Return path -> syntax tree of all modules."""
    return {
        path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for folder in (*SOURCE, "tests")
        for path in sorted((ROOT / folder).rglob("*.py"))
    }


def bound(tree):
    """Yield the names that a module binds."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name


def test_docstrings_begin_with_a_subject_or_a_verb():
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    assert not [
        f"{path}: {text.splitlines()[0]}"
        for path, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, documented) and (text := ast.get_docstring(node, clean=False))
        if text.split()[0].rstrip(",") in NO_SUBJECT
    ]


def test_names_are_not_vague():
    vague = [f"{path}: {n}" for path, tree in modules().items() for n in bound(tree) if n in VAGUE]
    in_tests = [line for line in vague if line.startswith("tests/")]
    assert sorted({*vague}.difference(in_tests) ^ EXCEPTIONS) == []
    assert len(in_tests) <= MOST_IN_TESTS, in_tests
