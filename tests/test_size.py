"""Tests that the project stays small enough for a newcomer to understand.

If you raise a limit here, say in the commit message what users get for it.
"""

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
    "lines of source": 34_012,
    "tokens of source": 231_280,
    "files of source": 241,
    "lines of tests": 24_000,
    "tokens of tests": 215_000,
    "words of docs": 49_400,
    "pages of docs": 24,
    "tracked files": 660,
    "tracked MB": 9,
    "commands": 14,
    "extras for users": 8,
    "virtual environments": 6,
    "lines that ruff may not format": 60,
}
ROOMS = {  # maximum lines of source in a folder
    "experiments/evaluation": 1_992,
    "experiments/training": 3_062,
    "experiments/reporting/webpage": 1_060,
    "mmwave_env/datasets": 1_645,
    "mmwave_env/engines": 1_991,
    "mmwave_env/filters": 2_536,
    "mmwave_env/localization": 2_958,
    "mmwave_env/world": 2_135,
}
SOURCE = ("mmwave_env", "experiments", "policies")
FOR_DEVELOPERS = {"dev", "docs", "lint"}  # extras for developers only
NO_TOKENS = {getattr(tokenize, name) for name in ["COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT"]}


def tokens(text: str) -> int:
    """Count Python tokens without docstrings; packing more into a line does not lower the count."""
    return sum(
        token.type not in NO_TOKENS and not token.string.startswith(('"""', 'r"""'))
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
    )


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
    source, tests = code(tracked, *SOURCE), code(tracked, "tests")
    python = [text for path, text in (source | tests).items() if path.suffix == ".py"]
    pages = [tracked[p] for p in tracked if p.parts[0] == "docs" and p.suffix == ".md"]
    project = tomllib.loads(tracked[Path("pyproject.toml")].decode())["project"]
    makefile = tracked[Path("Makefile")].decode()
    sizes = {
        "lines of source": sum(text.count("\n") for text in source.values()),
        "tokens of source": sum(tokens(t) for p, t in source.items() if p.suffix == ".py"),
        "files of source": len(source),
        "lines of tests": sum(text.count("\n") for text in tests.values()),
        "tokens of tests": sum(tokens(t) for p, t in tests.items() if p.suffix == ".py"),
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


def test_folders_are_within_their_budget(tracked):
    lines = Counter()
    for path, text in code(tracked, *SOURCE).items():
        for depth in range(2, len(path.parts)):
            lines["/".join(path.parts[:depth])] += text.count("\n")
    assert not {room: lines[room] for room, most in ROOMS.items() if lines[room] > most}
