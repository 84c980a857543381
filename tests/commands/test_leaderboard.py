"""mmwave-loc leaderboard, as it is typed."""

import json

import pytest

from experiments.evaluation.protocol import entry, judge, venues
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    """A folder with entries of two contenders, of few episodes."""
    folder = tmp_path_factory.mktemp("entries")
    names = ["imm-best", "speed-rule"]
    judged = [judge(names, venue, 2, 0) for venue in venues()]
    for name in names:
        (folder / f"{name}.json").write_text(json.dumps(entry(name, judged)))
    return folder


@pytest.mark.slow
def test_entries_are_ranked_and_a_page_is_renewed(entries, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- table: leaderboard -->\n<!-- end -->\n<!-- table: venues -->\n<!-- end -->\n"
    )
    shown = succeed("leaderboard", "--out", entries, "--docs", page)
    best = "| imm-best | 2 / 2 | 0.000 [0.000, 0.000]"
    assert shown.index(best) < shown.index("| speed-rule | 2 / 2 | -")
    assert all(f"| {venue.name} | " in shown for venue in venues())
    for line in shown.splitlines():
        assert line in page.read_text()


@pytest.mark.slow
def test_what_is_no_entry_is_refused(entries, tmp_path):
    good = json.loads((entries / "imm-best.json").read_text())
    for damage, message in (
        ({"venues": {}}, "venues: missing street:handset, "),
        ({"mean_gain": {}}, "not an entry: "),
    ):
        (tmp_path / "bad.json").write_text(json.dumps(good | damage))
        assert_one_clear_line(command("leaderboard", "--out", tmp_path), f"bad.json: .*{message}")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--episodes", "1"], "episodes: found 1, expected at least 2"),
        (["--draws", "0"], "draws: found 0, expected at least 2"),
        ([], "out: found no entries in .*; --policies makes some"),
    ],
)
def test_nothing_to_judge_is_refused(options, message, tmp_path):
    assert_one_clear_line(command("leaderboard", *options, "--out", tmp_path), message)


def test_a_contender_that_there_is_not_is_refused_before_any_venue(tmp_path):
    done = command("leaderboard", "--policies", "imm-bets", "--out", tmp_path)
    assert_one_clear_line(done, "policy: found 'imm-bets', expected one of .*imm-best")


def test_every_entry_is_shown_with_its_episodes(tmp_path):
    made = json.loads((ROOT / "docs" / "leaderboard" / "guided.json").read_text())
    for venue in made["venues"].values():
        venue["episodes"] = 5 if venue["kind"] == "recorded" else 20
    (tmp_path / "short.json").write_text(json.dumps(made | {"entry": "short"}))
    assert "| short | 20 / 5 | " in succeed("leaderboard", "--out", tmp_path)


def test_a_file_that_is_no_json_is_named(tmp_path):
    (tmp_path / "mine.json").write_text("{")
    assert_one_clear_line(command("leaderboard", "--out", tmp_path), "mine.json: not an entry")
