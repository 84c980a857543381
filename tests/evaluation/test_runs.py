"""Folders of runs: what is read of them, and what is said of damaged ones."""

import json
from pathlib import Path

import pytest

from experiments.evaluation.runs import Run, trainings
from policies import LearnedSwitch, shipped_policies
from tests.paths import ROOT

SUMMARY = {"seeds": [{"seed": 2}, {"seed": 0}, {"seed": 1}], "median": 0, "command": "..."}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    return tmp_path


def test_a_run_has_its_seeds_best_first_and_a_median(folder):
    run = Run.read(str(folder))
    assert (run.name, run.seeds, run.median) == (str(folder), (2, 0, 1), 0)
    assert run.policies == [str(folder / f"seed-{i}" / "policy.safetensors") for i in (2, 0, 1)]
    assert run.policy == run.policies[1]


def test_trainings_take_the_place_of_their_run(folder):
    run = Run.read(str(folder))
    assert trainings(["imm", run.name, "ppo"], {run.name: run}) == ["imm", *run.policies, "ppo"]


DAMAGE = {
    "no JSON": ("{", "Expecting property name"),
    "a list": ("[]", "found list, expected an object"),
    "no seeds": (json.dumps({"median": 0}), "seeds: found none"),
    "no median": (json.dumps({"seeds": [{"seed": 0}]}), "median: found none"),
    "empty": (json.dumps({"seeds": [], "median": 0}), r"seeds: found \[\], expected different"),
    "twice": (json.dumps({"seeds": [{"seed": 0}] * 2, "median": 0}), r"seeds: found \[0, 0\]"),
    "words": (json.dumps({"seeds": [{"seed": "a"}], "median": "a"}), r"seeds: found \['a'\]"),
    "another median": (json.dumps(SUMMARY | {"median": 7}), "median: found 7.*one of.*2, 0, 1"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_summary_is_named(folder, damage):
    content, message = DAMAGE[damage]
    (folder / "summary.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(ValueError, match=message) as error:
        Run.read(str(folder))
    assert str(folder / "summary.json") in str(error.value)
    assert "\n" not in str(error.value)


def test_a_smoke_run_is_refused(folder):
    summary = SUMMARY | {"command": "mmwave-loc train --radio high --smoke"}
    (folder / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(ValueError, match="found what train --smoke left"):
        Run.read(str(folder))


def test_a_run_that_is_not_over_is_refused(folder):
    (folder / "summary.json").unlink()
    with pytest.raises(FileNotFoundError, match="summary.json: found no file.*--resume"):
        Run.read(str(folder))


@pytest.mark.parametrize("name", ["guided", "guided-ppo", "ppo-handset", "ppo-standard"])
def test_a_shipped_policy_is_the_median_of_its_five_trainings(name):
    run = Run.read(str(ROOT / "docs" / "learning" / name))
    shipped = shipped_policies()[name]
    assert len(run.seeds) == 5 and run.median == run.seeds[2]
    assert shipped.read_bytes() == Path(run.policy).read_bytes()
    cards = [LearnedSwitch(path).card for path in run.policies]
    assert [card.seed for card in cards] == list(run.seeds)
    assert all(card.evaluation["seed"] >= 5_000_000 for card in cards)  # no test seeds
    rewards = [card.evaluation["reward"] for card in cards]
    assert rewards == sorted(rewards, reverse=True)
