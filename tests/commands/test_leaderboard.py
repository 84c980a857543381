"""Tests of ``mmwave-loc leaderboard``, which ranks policies by their results in JSON files."""

import shutil

import pytest

from experiments.evaluation import protocol
from experiments.evaluation.protocol import entry, judge, sites
from experiments.leaderboard import Args, main
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT, json_in, write_json

FOLDER = ROOT / "experiments" / "evaluation" / "entries"
# two policies with files in this folder, the better policy first
GOOD = "guided"
POOR = "imm-best"


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    """Return a folder with the files of two policies, which were evaluated on few episodes."""
    folder = tmp_path_factory.mktemp("entries")
    names = ["imm-best", "speed-rule"]
    judged = [judge(names, site, 2, 0) for site in sites()]
    for name in names:
        write_json(folder / f"{name}.json", entry(name, judged))
    return folder


@pytest.mark.slow
def test_entries_are_ranked(entries):
    shown = succeed("leaderboard", "--out", entries)
    best = "| imm-best (too few: 2 / 2) | "
    assert shown.index(best) < shown.index("| speed-rule (too few: 2 / 2) | ")
    assert all(f"| {site.name} | " in shown for site in sites())


@pytest.mark.slow
def test_the_option_keep_skips_policies_that_already_have_a_file(entries, tmp_path, monkeypatch):
    shutil.copy(entries / "imm-best.json", tmp_path)
    judged = set()

    def judging(names, *rest):
        judged.update(names)
        return judge(names, *rest)

    monkeypatch.setattr(protocol, "judge", judging)
    main(Args(policies=("imm-best", "speed-rule"), episodes=2, draws=2, keep=True, out=tmp_path))
    assert judged == {"speed-rule"}


def test_a_file_that_is_not_an_entry_is_refused(tmp_path):
    good = json_in(FOLDER / f"{GOOD}.json")
    for damage, message in (
        ({"sites": {}}, "sites: missing street:handset, "),
        ({"mean_gain": {}}, "not an entry: "),
    ):
        write_json(tmp_path / "bad.json", good | damage)
        assert_one_clear_line(command("leaderboard", "--out", tmp_path), f"bad.json: .*{message}")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--episodes", "1"], "episodes: found 1, expected at least 2"),
        (["--draws", "0"], "draws: found 0, expected at least 2"),
        (["--policies", "imm-bets"], "policy: found 'imm-bets', did you mean imm-best[?] Expected"),
        ([], "mine.json: not an entry"),
    ],
)
def test_a_mistake_is_refused_before_episodes_are_played(options, message, tmp_path):
    if not options:
        (tmp_path / "mine.json").write_text("{")
    assert_one_clear_line(command("leaderboard", *options, "--out", tmp_path), message)


@pytest.mark.parametrize(("episodes", "draws"), [(1999, 200), (2000, 199)])
def test_an_entry_with_too_few_episodes_comes_last_and_is_marked(episodes, draws, tmp_path):
    good = json_in(FOLDER / f"{GOOD}.json")
    poor = json_in(FOLDER / f"{POOR}.json")
    write_json(tmp_path / "full.json", poor)
    for site in good["sites"].values():
        site["episodes"] = draws if site["kind"] == "recorded" else episodes
    write_json(tmp_path / "a-short.json", good | {"entry": "short"})
    shown = succeed("leaderboard", "--out", tmp_path)
    short = f"| short (too few: {episodes} / {draws}) | "
    assert shown.index(f"| {POOR} | ") < shown.index(short)
