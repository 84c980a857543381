"""docs/report.html: the report of the published results, which the documentation site shows."""

import json
import re
import shlex

from experiments.evaluation.intervals import Interval
from experiments.evaluation.markdown import rounded
from tests.cli import succeed
from tests.paths import ROOT
from tests.webpage.reading import Read

DOCS = ROOT / "docs"
TEXT = (DOCS / "report.html").read_text(encoding="utf-8")
PAGE = Read(TEXT)
RESULTS = json.loads((DOCS / "results.json").read_text(encoding="utf-8"))


def made_by():
    """The command line in docs/commands.md that makes it."""
    (line,) = re.findall(
        r"^mmwave-loc (report .* --out docs/report.html .*)$",
        (DOCS / "commands.md").read_text("utf-8"), re.MULTILINE,
    )  # fmt: skip
    return line


def test_it_is_small_loads_nothing_and_says_the_command_of_the_docs():
    assert len(TEXT.encode()) < 2_000_000
    addresses = [known[key] for _, known in PAGE.tags for key in ("src", "href") if key in known]
    assert addresses == ["data:,"]
    assert f"mmwave-loc {made_by()}" in PAGE.text


def test_its_figures_are_those_of_the_published_results_and_of_the_readme():
    readme = dict(
        re.findall(r"^\| ([\w-]+) \| (.*) \|$", (ROOT / "README.md").read_text("utf-8"), re.M)
    )
    header, *rows = PAGE.table("Means")
    assert len(rows) == len(RESULTS["policies"]) == 6 and len(header) == 8
    for (name, _), *cells in rows:
        figures = RESULTS["policies"][name].values()
        assert [float(value) for _, value in cells] == [one["mean"] for one in figures]
        shown = [rounded(Interval.of(one)) for one in figures]
        assert [text for text, _ in cells] == shown == readme[name].split(" | ")


def test_it_is_of_test_seeds():
    assert RESULTS["seed"] == 0 and RESULTS["episodes"] == 1000
    assert "Seeds 0 to 999" in PAGE.text


def test_it_has_episodes_to_play():
    episodes = json.loads(PAGE.data)["episodes"]
    assert episodes and all(set(one["contenders"]) == set(RESULTS["policies"]) for one in episodes)


def test_it_is_what_the_command_makes_today(tmp_path):
    """Tables of all that is not played again, and what draws and styles the page."""
    words = shlex.split(made_by())
    words[words.index("--out") + 1] = str(tmp_path / "report.html")
    succeed(*words, "--episodes", 0)
    made = (tmp_path / "report.html").read_text(encoding="utf-8")
    shown = {
        caption: rows for caption, rows in PAGE.tables.items() if "of the epochs" not in caption
    }
    assert Read(made).tables == shown
    for part in ("<style>.*?</style>", "<script>.*?</script>"):
        assert re.findall(part, made, re.DOTALL) == re.findall(part, TEXT, re.DOTALL)
