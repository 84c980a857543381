"""Whatever README and docs show is there and runs: links, blocks, command lines, names."""

import json
import re
import shlex
from contextlib import nullcontext
from pathlib import Path

import pytest

from experiments.console.main import read_arguments
from tests.cli import succeed
from tests.paths import ROOT

DOCS = ROOT / "docs"
NOTEBOOKS = sorted(DOCS.glob("notebooks/*.ipynb"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md")), *NOTEBOOKS]


def text_of(page: Path) -> str:
    """A page; of a notebook the words, as Jupyter and tests/test_notebook.py run the code."""
    text = page.read_text(encoding="utf-8")
    if page not in NOTEBOOKS:
        return text
    cells = json.loads(text)["cells"]
    return "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")


TEXT = {page.name: text_of(page) for page in PAGES}
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def prose(page: str) -> str:
    """A page without its blocks."""
    return BLOCK.sub("", TEXT[page])


# --- links


def anchors(page: Path) -> set[str]:
    """What links into a page may name, as GitHub makes it of the headings."""
    if page.suffix == ".html":
        return set(re.findall(r' id="tab-([^"]+)"', page.read_text("utf-8")))  # of a report
    headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=TEXT)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page.name)):
        if "://" not in target:
            path, _, anchor = target.partition("#")
            found = (page.parent / path).resolve() if path else page
            assert found.exists(), target
            assert not anchor or anchor in anchors(found), target


# --- blocks


def command_lines():
    """Every ``mmwave-loc ...`` of the pages, in blocks and in prose."""
    for page, text in TEXT.items():
        blocks = "\n".join(body for _, body in BLOCK.findall(text)).replace("\\\n", " ")
        found = re.findall(r"^mmwave-loc (.*)$", blocks, re.MULTILINE)
        found += re.findall(r"`mmwave-loc ([^`<]+)`", prose(page))
        yield from ((page, " ".join(line.split())) for line in found)


LINES = sorted(set(command_lines()))


@pytest.mark.parametrize(("page", "line"), LINES, ids=[f"{p}: {line[:60]}" for p, line in LINES])
def test_command_lines_are_understood(page, line):
    name, *options = shlex.split(line)
    if name.startswith("-"):
        assert succeed(name)
        return
    if options:  # a name alone stands for the command, whose arguments need not be there
        with nullcontext() if "--help" not in options else pytest.raises(SystemExit, match="0"):
            read_arguments(name, options)


def test_targets_of_make_are_there():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for page, text in TEXT.items():
        for target in re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{page}: make {target}"
