"""Every example runs with its library, and beats the best fixed mode; the page of clients is right.

Examples whose libraries are not installed are skipped; `make examples` installs them all.
"""

import ast
import os
import re
import shlex
import subprocess
import sys

import pytest

from tests.paths import ROOT

FOLDER = ROOT / "examples"
MAKERS = {"raytrace", "sumo", "minari_collect"}  # these make data, and train no agent
EXAMPLES = {path.stem: path for path in sorted(FOLDER.glob("*.py")) if path.stem not in MAKERS}
PAGE = (ROOT / "docs" / "clients.md").read_text("utf-8")


def imported(source: str) -> set[str]:
    """The packages that a script imports."""
    nodes = list(ast.walk(ast.parse(source)))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.split(".")[0] for name in names}


def rewards(told: str) -> dict[str, float]:
    """Rewards by name, the agent's first, from a table of `compare` or a line each."""
    row, line = r"\| ([\w-]+) \| (-\d+\.\d+) ±", r"([\w-]+): reward (-\d+\.\d+)"
    found = re.findall(rf"^(?:{row}|{line})", told.partition("Paired")[0], re.MULTILINE)
    return {a or c: float(b or d) for a, b, c, d in found}


def made_before(source: str) -> list[list[str]]:
    """The commands that make what an example reads, which its docstring shows."""
    said = ast.get_docstring(ast.parse(source)) or ""
    lines = re.findall(r"^python (examples/.*)$", said, re.MULTILINE)
    return [[str(ROOT / script), *words] for script, *words in map(shlex.split, lines)]


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_short(name):
    """At most 30 lines that do something."""
    source = EXAMPLES[name].read_text("utf-8")
    begin = max(node.end_lineno for node in ast.parse(source).body if node.col_offset == 0
                and isinstance(node, (ast.Import, ast.ImportFrom)))  # fmt: skip
    assert len([line for line in source.splitlines()[begin:] if line.strip()]) <= 30


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_beats_the_best_fixed_mode(name, tmp_path):
    source = EXAMPLES[name].read_text("utf-8")
    for package in imported(source):
        pytest.importorskip(package)
    for words in [*made_before(source), [str(EXAMPLES[name])]]:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", *words],
            env=os.environ | {"PYTHONPATH": str(ROOT), "MINARI_DATASETS_PATH": str(tmp_path)},
            capture_output=True,
            text=True,
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stderr
    found = rewards(done.stdout)
    assert next(iter(found.values())) > found["fixed-ukf"], done.stdout


def test_the_page_of_clients_has_every_example_and_the_versions_they_run_with():
    pins = {}
    for path in FOLDER.glob("*.txt"):
        pins |= dict(re.findall(r"^([\w-]+)(?:\[.*\])?==(\S+)$", path.read_text("utf-8"), re.M))
    torch = re.search(r"^torch==(\S+)$", (ROOT / "constraints.txt").read_text("utf-8"), re.M)[1]
    rows = re.findall(
        r"^\| (.+?) \| `([\w-]+) ([\d.]+)` \|.*\(\.\./examples/(\w+)\.py\)", PAGE, re.M
    )
    assert {package: version for _, package, version, _ in rows} == {
        package: version for package, version in (pins | {"torch": torch}).items()
        if package != "gymnasium"
    }  # fmt: skip
    assert {example for *_, example in rows} == set(EXAMPLES)
