"""Whatever README and docs show is there and runs: links, blocks, command lines, tables."""

import re
import shlex
from contextlib import nullcontext
from dataclasses import replace

import pytest

from experiments.console.main import COMMANDS, read_arguments
from tests.cli import succeed
from tests.pages import BLOCK, NUMBER, PAGES, Session, blocks_of, made
from tests.paths import ROOT

TEXT = {page.name: page.read_text(encoding="utf-8") for page in PAGES}
BLOCKS = {page: blocks_of(page) for page in PAGES}
EXTRAS = {"torch", "stable_baselines3", "minari", "matplotlib", "pyarrow"}  # not everywhere


def prose(name: str) -> str:
    """A page without its blocks."""
    return BLOCK.sub("", TEXT[name])


# --- links


def anchors(page):
    """Return the anchors of a page, as GitHub makes them of the headings."""
    headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", page.read_text("utf-8")), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=TEXT)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page.name)):
        if "://" not in target:
            path, _, anchor = target.partition("#")
            found = (page.parent / path).resolve() if path else page
            assert found.exists(), target
            assert not anchor or found.suffix != ".md" or anchor in anchors(found), target


# --- command lines


def command_lines():
    """Every ``mmwave-loc ...`` of the pages, in blocks and in prose."""
    for page, blocks in BLOCKS.items():
        found = [line for block in blocks for line in block.commands]
        found += re.findall(r"`mmwave-loc ([^`<]+)`", prose(page.name))
        yield from ((page.name, " ".join(line.split())) for line in found)


LINES = sorted(set(command_lines()))


@pytest.mark.parametrize(("page", "line"), LINES, ids=[f"{p}: {line[:60]}" for p, line in LINES])
def test_command_lines_are_understood(page, line):
    name, *options = shlex.split(line)
    if name.isupper():  # such as NAME: any of them
        return
    if name.startswith("-"):
        assert succeed(name)
        return
    assert name in COMMANDS
    if options:  # a name alone stands for the command, whose arguments need not be there
        with nullcontext() if "--help" not in options else pytest.raises(SystemExit, match="0"):
            read_arguments(name, options)


def test_targets_of_make_are_there():
    makefile = (ROOT / "Makefile").read_text("utf-8")
    for page, text in TEXT.items():
        for target in re.findall(r"(?:^|`)make ([a-z-]+)", text, re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{page}: make {target}"


# --- examples


def test_every_block_of_python_says_whether_it_is_run():
    silent = [
        f"{page.name}:{block.line}"
        for page, blocks in BLOCKS.items()
        for block in blocks
        if block.language == "python" and not (block.mark or block.text.startswith(">>>"))
    ]
    assert silent == []


EXAMPLES = [
    pytest.param(
        page, block, id=f"{page.stem}-{block.line}",
        marks=[pytest.mark.slow] if "slow" in block.words else [],
    )
    for page, blocks in BLOCKS.items()
    for block in blocks
    if block.mark.startswith("example") and not block.file
]  # fmt: skip


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """One a page."""
    begun = {}

    def session(page):
        if page not in begun:
            begun[page] = Session(page, tmp_path_factory.mktemp(page.stem))
        return begun[page]

    return session


@pytest.mark.filterwarnings("ignore:speed .* is outside the design window")
@pytest.mark.parametrize(("page", "block"), EXAMPLES)
def test_examples_run_and_print_what_is_shown(page, block, sessions):
    session = sessions(page)
    try:
        for earlier in BLOCKS[page]:
            quick = "slow" not in earlier.words or "slow" in block.words
            if earlier.line < block.line and earlier.mark.startswith("example") and quick:
                session.printed(earlier)
        printed = session.printed(block)
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        pytest.skip(f"no {error.name}")
    for table in block.tables:
        assert_alike(table["shown"], made(table, printed, session.folder))


def assert_alike(shown, now):
    """Two texts are the same, but for rounding, which may differ by processor."""
    assert NUMBER.sub("", shown).split() == NUMBER.sub("", now).split()
    for a, b in zip(NUMBER.findall(shown), NUMBER.findall(now), strict=True):
        a, b = (float(number.replace(",", "")) for number in (a, b))
        assert a == pytest.approx(b, rel=0.02, abs=0.02), (a, b)


@pytest.mark.slow
@pytest.mark.torch
@pytest.mark.filterwarnings(
    "default:speed above 20 m/s"
)  # some cars are faster than the rule's design
def test_the_readme_s_training_learns_something(tmp_path):
    """Three seeds gained 0.046 to 0.061 on fixed-ukf: 0.02 is no matter of luck."""
    pytest.importorskip("stable_baselines3")
    page = ROOT / "README.md"
    (block,) = (block for block in BLOCKS[page] if block.language == "python")
    paired = (
        Session(page, tmp_path)
        .printed(replace(block, mark="example"))
        .split("Paired differences")[1]
    )
    (header,) = re.findall(r"^\| reward of \| (.*) \|$", paired, re.MULTILINE)
    (gains,) = re.findall(r"^\| mine \| (.*) \|$", paired, re.MULTILINE)
    cells = zip(header.split(" | "), gains.split(" | "), strict=True)
    gain = {name: float(cell.split()[0]) for name, cell in cells}
    assert gain["minus fixed-ukf"] >= 0.02 and gain["minus speed-rule"] >= 0.02, paired
