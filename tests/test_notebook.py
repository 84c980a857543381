"""docs/notebooks/first_switcher.ipynb runs as it stands, and is stored without outputs."""

import json
import os
import re

import pytest

from tests.paths import ROOT

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


def test_it_says_how_to_install_what_it_needs_and_so_does_the_page_that_links_it():
    install = 'pip install -e ".[train,plot,render]" -c constraints.txt'
    page = (ROOT / "docs" / "first-switcher.md").read_text("utf-8")
    for text in ("".join(NOTEBOOK["cells"][0]["source"]), page):
        assert install in text and "jupyterlab" in text


@pytest.fixture(scope="module")
def outputs():
    """What the cells show when they are run in a new kernel, by the cell's id."""
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
