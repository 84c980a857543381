"""Tests of the language of docstrings and names."""

import ast
from collections import Counter

from tests.paths import ROOT

FOLDERS = ("mmwave_env", "policies", "experiments", "tests", "examples", "docs/site")
MODULES = {
    path.relative_to(ROOT): ast.parse(path.read_text(encoding="utf-8"))
    for folder in FOLDERS
    for path in sorted((ROOT / folder).rglob("*.py"))
}
NO_SUBJECT = {"What", "How", "Where", "Who", "Of", "As", "By"}
VAGUE = {"found", "one", "told", "seen", "what", "there", "given"}
MOST_VAGUE = 930  # bindings; falls with every function that is edited, and never rises


def bound(node):
    """Yield the names that a node binds."""
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
        for path, tree in MODULES.items()
        for node in ast.walk(tree)
        if isinstance(node, documented) and (text := ast.get_docstring(node))
        if text.split()[0].rstrip(",") in NO_SUBJECT
    ]


def test_names_say_what_they_stand_for():
    names = Counter(
        name for tree in MODULES.values() for node in ast.walk(tree) for name in bound(node)
    )
    assert sum(names[name] for name in VAGUE) <= MOST_VAGUE
