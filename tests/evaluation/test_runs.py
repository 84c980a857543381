"""Tests that folders of training runs can be read, and that damaged folders are refused."""

import json
from pathlib import Path

import pytest

from experiments.evaluation.contenders import Run, contender_from
from mmwave_env.models.layout import Layout
from policies import LearnedSwitch, shipped_policies
from tests.paths import ROOT
from tests.refusals import refuses

DAMAGE = {  # name -> content of a summary, keys that the error names
    "not JSON": ("{", []),
    "no seeds": ({"median": 0}, ["seeds"]),
    "no median": ({"seeds": [{"seed": 0}]}, ["median"]),
    "empty seeds": ({"seeds": [], "median": 0}, ["seeds"]),
    "a seed twice": ({"seeds": [{"seed": 0}] * 2, "median": 0}, ["seeds"]),
    "unknown median": ({"seeds": [{"seed": 0}], "median": 7}, ["median"]),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_the_error_names_a_damaged_summary(tmp_path, damage):
    content, named = DAMAGE[damage]
    text = content if isinstance(content, str) else json.dumps(content)
    (tmp_path / "summary.json").write_text(text)
    with refuses(tmp_path / "summary.json", *named):
        Run.read(str(tmp_path))


@pytest.mark.parametrize("name", ["guided", "guided-ppo", "ppo-handset", "ppo-standard"])
def test_a_shipped_policy_is_the_median_of_its_five_training_seeds(name):
    run = Run.read(str(ROOT / "docs" / "learning" / name))
    shipped = shipped_policies()[name]
    assert len(run.seeds) == 5 and run.median == run.seeds[2]
    assert shipped.read_bytes() == Path(run.policy).read_bytes()
    cards = [LearnedSwitch(path).card for path in run.policies]
    assert [card.seed for card in cards] == list(run.seeds)
    assert all(card.evaluation["seed"] >= 5_000_000 for card in cards)  # none is a test seed
    rewards = [card.evaluation["reward"] for card in cards]
    assert rewards == sorted(rewards, reverse=True)
    played = contender_from(run.name, "standard" if name == "ppo-standard" else "handset")
    assert played.start(Layout()).card.seed == run.median
