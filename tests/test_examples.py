"""Every example runs with its library, and beats the best fixed mode; the notebook runs, too.

Examples whose libraries are not installed are skipped; `make examples` installs them all.
"""

import ast
import json
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
PAGE = (ROOT / "docs" / "own-agent.md").read_text("utf-8")


def imported(source: str) -> set[str]:
    """The modules that a script imports."""
    nodes = list(ast.walk(ast.parse(source)))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
    return set(names)


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
    for module in imported(source):
        pytest.importorskip(module, exc_type=ImportError)
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
        package: version
        for package, version in (pins | {"torch": torch}).items()
        if package != "gymnasium"
    }
    assert {example for *_, example in rows} == set(EXAMPLES)


# --- the notebook

PATH = ROOT / "docs" / "notebooks" / "first_switcher.ipynb"
NOTEBOOK = json.loads(PATH.read_text("utf-8"))
CELLS = {cell["id"]: cell for cell in NOTEBOOK["cells"]}
CODE = {name: cell for name, cell in CELLS.items() if cell["cell_type"] == "code"}


def test_what_running_leaves_behind_is_not_stored():
    for cell in CODE.values():
        assert cell["outputs"] == [] and cell["execution_count"] is None
    assert all(cell["metadata"] == {} for cell in CELLS.values())
    assert set(NOTEBOOK["metadata"]) == {"kernelspec", "language_info"}
    assert set(NOTEBOOK["metadata"]["language_info"]) == {"name"}  # and no version of Python


@pytest.mark.parametrize("name", CODE)
def test_every_cell_compiles_and_has_its_words_above(name):
    compile("".join(CODE[name]["source"]), name, "exec")
    names = list(CELLS)
    assert CELLS[names[names.index(name) - 1]]["cell_type"] == "markdown"


@pytest.fixture(scope="module")
def outputs():
    """Return the outputs of the cells, run in a new kernel, by the cell's id."""
    nbclient, nbformat = map(pytest.importorskip, ("nbclient", "nbformat"))
    notebook = nbformat.read(PATH, as_version=4)
    nbformat.validate(notebook)
    folder = {"metadata": {"path": PATH.parent}}  # where Jupyter runs it
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
        nbclient.NotebookClient(notebook, resources=folder, timeout=600).execute()
    return {cell["id"]: cell["outputs"] for cell in notebook.cells if cell.cell_type == "code"}


def shown(outputs, kind):
    """Cells that show something of a kind, with the last of it."""
    return {
        name: one["data"][kind]
        for name, found in outputs.items()
        for one in found
        if kind in one.get("data", {})
    }


@pytest.mark.slow
@pytest.mark.torch
def test_it_runs_and_what_it_says_of_its_outputs_holds(outputs):
    said = [one["text"] for found in outputs.values() for one in found if one.get("name")]
    (error,) = (text for text in said if "position error" in text)
    assert float(error.split(":")[1]) > 50.0  # "Over 50 m!"
    assert not any("Warning: speed" in text for text in said)
    assert list(shown(outputs, "image/png")) == ["show-frame", "draw-rule", "again"]
    (tables,) = shown(outputs, "text/markdown").values()
    differences = tables.split("Paired differences")[1]
    header, mine = (
        [cell.strip() for cell in line.split("|")]
        for line in differences.splitlines()
        if line.startswith(("| reward of", "| mine"))
    )
    for other in ("speed-rule", "fixed-ukf"):  # better than both, and no luck
        assert float(re.findall(r"\[(.*?),", mine[header.index(f"minus {other}")])[0]) > 0.0
