"""The benchmark and studies on a report: read from files and folders, shown, or refused."""

import json

import pytest

from experiments.evaluation.intervals import Interval
from mmwave_env import __version__
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT
from tests.webpage import results
from tests.webpage.reading import Read
from tests.webpage.results import write

DOCS = ROOT / "docs"


def report(tmp_path, *words):
    """The page of results, nothing played again, taken apart."""
    out = tmp_path / "report.html"
    succeed("report", *words, "--episodes", 0, "--out", out)
    return Read(out.read_text(encoding="utf-8"))


def test_a_folder_of_entries_is_ranked_with_their_figures(tmp_path):
    page = report(tmp_path, DOCS / "leaderboard")
    entries = [json.loads(file.read_text()) for file in (DOCS / "leaderboard").glob("*.json")]
    gain = {
        one["entry"].removesuffix("/policy.safetensors"): one["mean_gain"]["to train in"]
        for one in entries
    }
    _, *rows = page.table("Entries")
    assert [row[0][0] for row in rows] == sorted(gain, key=lambda name: -gain[name]["mean"])
    for (name, _), _, (shown, value), *_ in rows:
        assert float(value) == gain[name]["mean"] and shown == str(Interval.of(gain[name]))
    assert [row[0][0] for row in page.table("best IMM of each venue")[1:]] == list(
        entries[0]["venues"]
    )
    assert page.text.count(entries[0]["command"]) == 1  # which wrote several files


def test_every_table_of_learned_is_shown(tmp_path):
    content = results.learned()
    page = report(tmp_path, write(tmp_path / "l.json", content))
    assert float(page.table("Means")[1][1][1]) == -1.0
    assert [row[0][0] for row in page.table("ppo-handset")[1:]] == ["0"]
    assert float(page.table("ablations")[1][1][1]) == -1.75
    assert page.table("places: reward")[1][1][0] == "0.250 [0.150, 0.350]"
    assert float(page.table("Reward where it was trained")[1][2][1]) == 0.375
    assert page.table("Other libraries")[1][0][0] == "CleanRL"
    (chart,) = [one for one in json.loads(page.data)["charts"] if one["title"] == "trust, handset"]
    errors, gain, shares = chart["views"]
    assert [line["y"] for line in errors["lines"]] == [[1.0, 2.0], [3.0, 3.0]]
    assert gain["lines"][0]["y"] == [-2.0, None] and gain["lines"][0]["low"] == [-2.1, None]
    assert shares["lines"][1]["y"] == [0.5, 0.25]


def entry(**more):
    return json.loads((DOCS / "leaderboard" / "guided.json").read_text()) | more


def learned(**more):
    return results.learned() | more


OLD = results.VERSIONS | {"mmwave-loc": "9.9"}
MISTAKES = {
    "an unknown key of an entry": (
        entry(new=1, versions=OLD), "r.json: new: found a key written by mmwave-loc 9.9 that "
        f"mmwave-loc {__version__} does not know in results of this kind \\(leaderboard\\)",
    ),
    "no venues": (entry(venues={}), "r.json: venues: missing .*, written by mmwave-loc"),
    "a part that is no object": (
        learned(new=3, versions=OLD), "r.json: new: found int, written by mmwave-loc 9.9",
    ),
    "a part of no intervals": (
        learned(new={"a": {"b": 1}}, versions=OLD),
        "r.json: new: new.a.b: found 1, expected a mean and its ci95, written by mmwave-loc 9.9",
    ),
    "a key in a part": (
        learned(handset=results.learned()["handset"] | {"surprise": 1}),
        "r.json: handset: surprise: found a key",
    ),
    "no outcomes": (learned(trainings={"a": [{}]}), "r.json: trainings: best: found none"),
    "a record of nothing": (
        results.defaults(rows=[{"library": "mine"}]),
        "r.json: beliefs: found none, written by an unknown version",
    ),
    "times without errors": (
        learned(**{"trust, handset": results.learned()["trust, handset"] | {"time_s": [0.0]}}),
        "r.json: trust, handset: stop.error_m.guided: found 2 epochs, expected 1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_studies_that_are_none_end_with_one_clear_line(tmp_path, mistake):
    content, message = MISTAKES[mistake]
    done = command("report", write(tmp_path / "r.json", content), "--out", tmp_path / "r.html")
    assert_one_clear_line(done, message)
    assert not (tmp_path / "r.html").exists()
