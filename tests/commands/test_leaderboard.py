"""Tests of ``mmwave-loc leaderboard``, which ranks policies by their results in JSON files."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation import protocol
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.protocol import entry, judge, sealed, sites, verify
from experiments.leaderboard import Args, main
from tests.cli import assert_refused, command, succeed
from tests.paths import ROOT, json_in, write_json

FOLDER = ROOT / "experiments" / "evaluation" / "entries"
# two policies with files in this folder, the better policy first
GOOD = "guided"
POOR = "imm-best"


def shipped(name):
    return json_in(FOLDER / f"{name}.json")


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    """Return a folder with the files of two policies, which were evaluated on few episodes."""
    folder = tmp_path_factory.mktemp("entries")
    names = ["imm-best", "speed-rule"]
    judged = {site: judge(names, site, 2, 0) for site in sites()}
    for name in names:
        write_json(folder / f"{name}.json", sealed(entry(name, judged)))
    return folder


@pytest.mark.slow
def test_entries_are_ranked(entries):
    shown = succeed("leaderboard", "--out", entries)
    best = "| imm-best (too few: 2 / 2) | "
    assert shown.index(best) < shown.index("| speed-rule (too few: 2 / 2) | ")
    assert all(f"| {site.name} | " in shown for site in sites())


@pytest.mark.slow
def test_the_option_keep_skips_policies_that_have_an_entry_and_did_not_change(
    entries, tmp_path, monkeypatch
):
    shutil.copy(entries / "imm-best.json", tmp_path)
    changed = {"policy": "of another file"}
    write_json(tmp_path / "guided.json", sealed(json_in(tmp_path / "imm-best.json") | changed))
    judged = set()

    def judging(names, *rest):
        judged.update(names)
        return judge(names, *rest)

    monkeypatch.setattr(protocol, "judge", judging)
    policies = ("imm-best", "speed-rule", "guided")
    main(Args(policies=policies, episodes=2, draws=2, keep=True, out=tmp_path))
    assert judged == {"speed-rule", "guided"}


def test_a_file_that_is_not_an_entry_is_refused(tmp_path):
    good = shipped(GOOD)
    for damage, message in (
        ({"sites": {}}, "not an entry: street:handset: found none"),
        ({"sites": good["sites"] | {"o1:handset": {}}}, "not an entry: "),
    ):
        write_json(tmp_path / "bad.json", sealed(good | damage))
        assert_refused(f"bad.json: .*{message}", "leaderboard", "--out", tmp_path)


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
    assert_refused(message, "leaderboard", *options, "--out", tmp_path)


@pytest.mark.parametrize(("episodes", "draws"), [(1999, 200), (2000, 199)])
def test_an_entry_with_too_few_episodes_comes_last_and_is_marked(episodes, draws, tmp_path):
    good = shipped(GOOD)
    poor = shipped(POOR)
    write_json(tmp_path / "full.json", poor)
    for site in sites():
        count = draws if site.kind == protocol.RECORDED else episodes
        good["sites"][site.name]["episodes"] = count
    write_json(tmp_path / "a-short.json", sealed(good | {"entry": "short"}))
    shown = succeed("leaderboard", "--out", tmp_path)
    short = f"| short (too few: {episodes} / {draws}) | "
    assert shown.index(f"| {POOR} | ") < shown.index(short)


AGENT = """
import numpy as np

class Cruise:
    beliefs = "per-mode"
    def __call__(self, observations):
        return np.full(len(observations), 2)
"""


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """Return a folder with a user's module and the entry of its agent, judged on few episodes."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "cruise.py").write_text(AGENT)
    few = ("--episodes", 20, "--draws", 4, "--out", "entries")
    succeed("leaderboard", "--policies", "cruise:Cruise", *few, cwd=folder)
    return folder


@pytest.fixture
def claimed(own, tmp_path, monkeypatch):
    """Return the path of a copy of this entry; the module is in the current folder."""
    shutil.copy(own / "cruise.py", tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "cruise", raising=False)
    return Path(shutil.copy(own / "entries" / "cruise-Cruise.json", tmp_path))


@pytest.mark.slow
def test_an_honest_entry_is_verified(claimed):
    assert verify(claimed) == []


CHANGES = {  # a changed figure, and what it is called
    "reward": lambda e: e["sites"]["street:handset"]["reward"].update(mean=-1.0),
    "hash": lambda e: e.update(policy="0" * 64),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_an_entry_with_a_changed_figure_is_refused(change, tmp_path):
    entry = shipped(GOOD)
    change(entry)
    write_json(tmp_path / "changed.json", entry)
    failed = command("leaderboard", "--verify", tmp_path / "changed.json")
    assert failed.returncode == 2
    assert "changed.json: refused" in failed.stdout and "seal: found content" in failed.stdout


def better(figure):
    """Return a change that raises this figure at all sites."""

    def change(entry):
        for site in entry["sites"].values():
            site[figure]["mean"] += 1.0

    return change


def surer(entry):
    for site in entry["sites"].values():
        site["minus"]["imm"]["ci95"] = [site["minus"]["imm"]["mean"]] * 2


def unknown(entry):
    entry["sites"]["o1:handset"]["over_rule"]["mean"] = float("nan")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (unknown, "o1:handset, over_rule: found nan"),
        (better("reward"), "reward: found"),
        (better("over_rule"), "over_rule: found"),
        (surer, "minus imm: found"),
        (CHANGES["hash"], "policy: found the hash"),
    ],
)
def test_a_changed_entry_is_refused_even_with_a_new_seal(change, message, claimed):
    entry = json_in(claimed)
    change(entry)
    write_json(claimed, sealed(entry))
    assert any(message in difference for difference in verify(claimed))


@pytest.mark.parametrize("missing", ["policy", "command"])
def test_an_entry_that_lacks_what_verification_needs_is_refused(missing, tmp_path):
    entry = shipped(GOOD)
    del entry[missing]
    write_json(tmp_path / "short.json", sealed(entry))
    failed = command("leaderboard", "--verify", tmp_path / "short.json")
    assert failed.returncode == 2 and f"{missing}: found none" in failed.stdout


@pytest.mark.slow
def test_an_entry_is_refused_if_its_policy_changes(claimed):
    Path("cruise.py").write_text(AGENT.replace("2", "1"))
    assert "policy: found the hash" in verify(claimed)[0]


@pytest.mark.parametrize("episodes", [2, 3])
def test_an_honest_claim_of_few_episodes_is_not_refused_by_chance(episodes, monkeypatch):
    rng = np.random.default_rng(0)
    site = sites()[0]

    def played(name, site, count, seed):  # rewards of the same agent in other episodes
        return {"reward": bootstrap([rng.normal(size=count)])[0]}

    monkeypatch.setattr(protocol, "_played", played)
    monkeypatch.setattr(protocol, "_figures", lambda stated: stated["figures"])
    monkeypatch.setattr(protocol, "SAME", np.inf)  # the claimed episodes do not matter here
    for _ in range(400):
        stated = {"episodes": episodes, "figures": played("", site, episodes, 0)}
        claimed = {"entry": "", "command": "mmwave-loc leaderboard", "sites": {site.name: stated}}
        assert not [*protocol._differences(claimed, site)]
