"""Whatever README and docs show is there and runs: links, blocks, command lines, names."""

import json
import re
import shlex
from contextlib import nullcontext
from pathlib import Path

import pytest

from experiments.cli.main import COMMANDS, STUDIES, commands, read_arguments
from mmwave_env.logs.log_columns import QUANTITIES
from tests.cli import succeed
from tests.paths import ROOT, numbers

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


def test_every_page_is_reached_from_the_readme():
    reached, todo = set(), [ROOT / "README.md"]
    while todo:
        page = todo.pop()
        if page not in reached:
            reached.add(page)
            links = re.findall(r"\]\(([^)#\s]+\.(?:md|ipynb))", page.read_text("utf-8"))
            todo += [(page.parent / link).resolve() for link in links if "://" not in link]
    assert set(PAGES) <= reached


# --- blocks


@pytest.mark.parametrize("page", TEXT)
def test_every_python_block_names_the_test_that_runs_it(page):
    for match in BLOCK.finditer(TEXT[page]):
        if match[1] == "python":
            before = TEXT[page][: match.start()]
            compile(match[2], page, "exec")
            (said,) = re.findall(r"<!-- .*run by (\S+\.py).* -->\n\Z", before) or re.findall(
                r"<!-- .*run by (\S+\.py), like every example of this page -->", TEXT[page]
            )
            runner = (ROOT / said).read_text("utf-8")
            assert f'"{page}"' in runner and "```python" in runner


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
    module, _ = commands()[name]
    if options:  # a name alone stands for the command, whose arguments need not be there
        with nullcontext() if "--help" not in options else pytest.raises(SystemExit, match="0"):
            read_arguments(module, options, name)


def test_targets_of_make_are_there():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for page, text in TEXT.items():
        for target in re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{page}: make {target}"


# --- commands.md, data.md, architecture.md, glossary.md


def test_every_command_is_in_the_table():
    installed, studies = TEXT["commands.md"].split("Seven more are studies")
    for part, known in ((installed, COMMANDS), (studies, STUDIES)):
        assert set(re.findall(r"^\| `([a-z-]+)` \|", part, re.MULTILINE)) == set(known)


def test_every_column_of_a_log_is_described():
    said = set(re.findall(r"`([a-z_]+)`", TEXT["data.md"]))
    assert {name for names in QUANTITIES.values() for name in names} <= said


def test_localizing_the_sample_prints_what_is_shown(tmp_path):
    page = TEXT["data.md"]
    command, diagnosis = re.findall(r"```\nmmwave-loc (localize .*?)\n```", page, re.DOTALL)
    assert "consistent as it is" in succeed(*shlex.split(diagnosis.replace("\\\n", " ")))
    words = shlex.split(command.replace("\\\n", " "))
    for name in ("track.tum", "track.png"):
        words[words.index(name)] = str(tmp_path / name)
    made = succeed(*words)
    shown = page.split("<!-- localize:")[1].split("-->\n", 1)[1].split("<!-- end of localize")[0]
    made = made.split("Written:")[0]
    assert re.sub(r"\d", "", made).split() == re.sub(r"\d", "", shown).split()
    assert numbers(shown) == pytest.approx(numbers(made), abs=0.002)
    assert (tmp_path / "track.png").exists()


def test_the_map_shows_every_file():
    page = TEXT["architecture.md"]
    table = page.split("| folder | files | about |")[1].split("\n\n")[0]
    folder, shown = "", set()
    for row in table.splitlines()[2:]:
        first, files, _ = (cell.strip() for cell in row.strip("|").split("|"))
        folder = first.strip("`/").split("/")[-1] or folder
        shown |= {f"{folder}/{name}" for name in re.findall(r"`(\w+)`", files)}
    there = {
        f"{path.parent.name}/{path.stem}"
        for package in ("mmwave_env", "policies")
        for path in (ROOT / package).rglob("*.py")
        if path.stem != "__init__"
    }
    assert there <= shown
    known = there | {
        f"{path.parent.name}/{path.stem}" for path in (ROOT / "experiments").rglob("*.py")
    }
    assert shown <= known
    for path in re.findall(r"`(\w+/\w+\.py)`", page):
        assert (ROOT / "mmwave_env" / path).exists() or (ROOT / path).exists(), path


LOCALIZATION = (
    "NEES", "NIS", "gate", "epoch", "anchor", "ToA", "AoA", "AoD", "CRLB", "EKF", "UKF", "CKF",
    "IMM", "RTS", "ATE", "RPE", "RMSE",
)  # fmt: skip
LEARNING = (
    "PPO", "episode", "key", "observation", "action", "reward", "policy", "vector", "autoreset",
    "training seed",
)  # fmt: skip


@pytest.mark.parametrize("word", LOCALIZATION + LEARNING)
def test_the_glossary_explains(word):
    rows = re.findall(r"^\| \*\*(.*?)\*\* \| (.*?) \| \[.*\]\(.*\) \|$", TEXT["glossary.md"], re.M)
    assert any(word in name for name, _ in rows)
