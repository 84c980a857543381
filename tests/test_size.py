"""Tests that the project stays small enough for a newcomer to understand.

If you raise a limit here, say in the commit message what users get for it.
"""

import ast
import io
import re
import subprocess
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from tests.paths import ROOT

BUDGET = {
    "files of source": 191,
    "words of docs": 33_000,
    "pages of docs": 27,
    "tracked files": 600,
    "tracked MB": 10,
    "commands": 12,
    "extras for users": 8,
    "virtual environments": 6,
    "lines that ruff may not format": 60,
}
ROOMS = {  # maximum tokens of a room; lines are free
    "experiments": 3_060,
    "experiments/console": 3_940,
    "experiments/evaluation": 11_640,
    "experiments/paper": 4_070,
    "experiments/reporting": 13_840,
    "experiments/sweeping": 2_540,
    "experiments/timing": 3_500,
    "experiments/training": 16_620,
    "mmwave_env": 6_180,
    "mmwave_env/compiler": 5_510,
    "mmwave_env/datasets": 8_640,
    "mmwave_env/engines": 11_020,
    "mmwave_env/filters": 17_970,
    "mmwave_env/interface": 7_140,
    "mmwave_env/io": 2_920,
    "mmwave_env/localization": 37_980,
    "mmwave_env/logs": 12_420,
    "mmwave_env/models": 10_010,
    "mmwave_env/numerics": 3_590,
    "mmwave_env/rendering": 7_330,
    "mmwave_env/world": 15_420,
    "policies": 7_230,
    "tests": 208_000,
}
PACKINGS = 3.0  # maximum per 1,000 lines: statements that say several things at once
SOURCE = ("mmwave_env", "experiments", "policies")
FOR_DEVELOPERS = {"dev", "docs", "lint"}  # extras for developers only
NO_TOKENS = {getattr(tokenize, name) for name in ["COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT"]}


def tokens(text: str) -> int:
    """Count Python tokens without docstrings; packing more into a line does not lower the count.

    An f-string is one token, as it is for Python 3.11.
    """
    count = 0
    inside = 0  # number of f-strings around a token
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        name = tokenize.tok_name[token.type]
        inside += name == "FSTRING_START"
        begins = name == "FSTRING_START" and inside == 1
        docstring = token.string.startswith(('"""', 'r"""'))
        count += begins or not (inside or token.type in NO_TOKENS or docstring)
        inside -= name == "FSTRING_END"
    return count


@pytest.fixture(scope="module")
def tracked():
    """Return the contents, by path, of the files that git tracks."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("needs a git checkout")
    paths = map(Path, listed.stdout.rstrip("\0").split("\0"))
    return {path: (ROOT / path).read_bytes() for path in paths if (ROOT / path).is_file()}


def code(tracked, *folders):
    """Return the texts, by path, of the programs in some folders."""
    return {
        path: content.decode()
        for path, content in tracked.items()
        if path.parts[0] in folders and path.suffix in (".py", ".js", ".css", ".html")
    }


def test_the_project_is_within_its_budget(tracked):
    source = code(tracked, *SOURCE)
    tests = code(tracked, "tests")
    python = [text for path, text in (source | tests).items() if path.suffix == ".py"]
    pages = [tracked[p] for p in tracked if p.parts[0] == "docs" and p.suffix == ".md"]
    project = tomllib.loads(tracked[Path("pyproject.toml")].decode())["project"]
    makefile = tracked[Path("Makefile")].decode()
    sizes = {
        "files of source": len(source),
        "words of docs": sum(len(page.split()) for page in pages),
        "pages of docs": len(pages),
        "tracked files": len(tracked),
        "tracked MB": sum(map(len, tracked.values())) / 1e6,
        "commands": sum(p.parent == Path("experiments") for p in source) - 1,  # __init__.py
        "extras for users": len(project["optional-dependencies"].keys() - FOR_DEVELOPERS),
        "virtual environments": len(set(re.findall(r"\.venv(?:-\w+)?(?=/)", makefile))),
        "lines that ruff may not format": sum(text.count("# fmt: " + "skip") for text in python),
    }
    assert not {name: f"{n} of {BUDGET[name]}" for name, n in sizes.items() if n > BUDGET[name]}


def room(path):
    """Return the room of a file: the folder in a package, or the package; tests are one room."""
    return (
        "/".join(path.parts[:2])
        if len(path.parts) > 2 and path.parts[0] != "tests"
        else path.parts[0]
    )


def test_rooms_are_within_their_budget(tracked):
    size = Counter()
    for path, text in code(tracked, *SOURCE, "tests").items():
        if path.suffix == ".py":
            size[room(path)] += tokens(text)
    assert not {
        name: f"{n} of {ROOMS.get(name, 0)}" for name, n in size.items() if n > ROOMS.get(name, 0)
    }


def packings(text):
    """Return the numbers of lines that a reader has to unpack.

    They assign several unrelated values at once, unpack a generator, or multiply a list by a
    condition. A swap is no packing.
    """
    return [node.lineno for node in ast.walk(ast.parse(text)) if unpacks(node) or splices(node)]


def unpacks(node):
    if not (isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple)):
        return False
    if not isinstance(node.value, ast.Tuple):
        return isinstance(node.value, ast.GeneratorExp)
    targets = {ast.unparse(target) for target in node.targets[0].elts}
    return targets != {ast.unparse(value) for value in node.value.elts}


def splices(node):
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult)):
        return False
    condition = isinstance(node.right, ast.Compare) or ast.unparse(node.right).startswith("bool(")
    return isinstance(node.left, ast.List) and condition


@pytest.mark.parametrize("folders", [SOURCE, ("tests",)])
def test_statements_say_one_thing_each(tracked, folders):
    texts = {p: text for p, text in code(tracked, *folders).items() if p.suffix == ".py"}
    packed = [f"{path}:{line}" for path, text in texts.items() for line in packings(text)]
    assert len(packed) <= PACKINGS * sum(text.count("\n") for text in texts.values()) / 1000, packed


def test_packings_are_recognized():
    assert packings("a, b = 1, 2") == packings("a, b = (f(x) for x in y)") == [1]
    assert packings("a = [1] * bool(x)") == packings("a = [1] * (x > 2)") == [1]
    assert packings("a, b = b, a\nn, m = x.shape\nc = [0] * n") == []
