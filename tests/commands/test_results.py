"""Tests of the options of compare and evaluate, and of the files they write for other programs."""

import csv
import json

import gymnasium
import numpy as np
import pytest

from mmwave_env.metrics import BURN_IN, INFO_KEYS, METRICS, TERMS
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT

SCHEMA = json.loads((ROOT / "mmwave_env/data/schemas/results.schema.json").read_text())
POLICIES = ("fixed-ekf", "fixed-ukf")
TWO = ("--policies", *POLICIES, "--episodes", 2, "--episode-steps", 15, "--seed", 4)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return the JSON content and the CSV rows of a comparison."""
    folder = tmp_path_factory.mktemp("results")
    succeed("compare", *TWO, "--json", folder / "r.json", "--episodes-csv", folder / "r.csv")
    with (folder / "r.csv").open() as file:
        return json.loads((folder / "r.json").read_text()), list(csv.DictReader(file))


@pytest.mark.slow  # evaluates two policies
def test_results_match_their_schema(results, tmp_path):
    validate = pytest.importorskip("jsonschema").validate
    validate(results[0], SCHEMA)
    succeed("evaluate", "--episodes", 1, "--episode-steps", 15, "--json", tmp_path / "one.json")
    alone = json.loads((tmp_path / "one.json").read_text())
    assert alone["policies"]["speed-rule"]["reward"]["ci95"] is None
    validate(alone, SCHEMA)


def test_the_option_percentiles_adds_percentiles_to_the_tables_and_the_file(results, tmp_path):
    assert "position_errors" not in results[0]
    shown = succeed("compare", *TWO, "--percentiles", "--json", tmp_path / "p.json")
    content = json.loads((tmp_path / "p.json").read_text())
    pytest.importorskip("jsonschema").validate(content, SCHEMA)
    errors = content.pop("position_errors")
    assert "--percentiles" in content["command"]
    other = {"command": "", "options": {}}
    assert content | other == results[0] | other
    assert errors["risk"] == 1e-3 and tuple(errors["policies"]) == POLICIES
    lines = shown.splitlines()
    terms = content["policies"]["fixed-ekf"]
    total = terms["reward"]["mean"] + sum(terms[term]["mean"] for term in TERMS)
    assert total == pytest.approx(0.0, abs=1e-9)
    assert "| policy | error term | NEES term |" in lines
    for name, kinds in errors["policies"].items():
        for kind, figures in kinds.items():
            (row,) = [line for line in lines if line.startswith(f"| {name}, {kind} |")]
            assert f" {figures['percentiles_m']['95']:#.3g} |" in row
            assert figures["epochs"] == 2 * (15 - BURN_IN)
    assert "at a risk of 0.001" in shown


def test_the_table_of_episodes_has_a_row_for_every_policy_and_seed(results):
    content, rows = results
    assert list(rows[0]) == ["policy", "seed", "key", *METRICS, *TERMS]
    assert [(row["policy"], row["seed"]) for row in rows] == [
        (name, seed) for name in POLICIES for seed in ("4", "5")
    ]
    for name in POLICIES:
        for metric, interval in content["policies"][name].items():
            values = [float(row[metric]) for row in rows if row["policy"] == name]
            assert np.mean(values) == pytest.approx(interval["mean"])


def test_a_seed_has_the_same_key_as_in_the_environment(results):
    env = gymnasium.make("MmWaveLoc-v0", episode_steps=15)
    assert {row["key"] for row in results[1] if row["seed"] == "5"} == {
        str(env.reset(seed=5)[1]["episode_key"])
    }


def test_recorded_episodes_have_seeds_but_no_keys(tmp_path):
    where = ("--data", "canyon28_vehicle", "--episode-steps", 15, "--episodes", 2)
    files = ("--json", tmp_path / "r.json", "--episodes-csv", tmp_path / "r.csv")
    succeed("evaluate", "--policy", "fixed-ukf", *where, *files)
    with (tmp_path / "r.csv").open() as file:
        assert [(row["seed"], row["key"]) for row in csv.DictReader(file)] == [("0", ""), ("1", "")]
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["scenario"] == "canyon28_vehicle" and list(content["policies"]) == ["fixed-ukf"]


def test_a_table_that_cannot_be_written_is_refused_before_episodes_are_played(tmp_path):
    (tmp_path / "a.csv").mkdir()
    done = command("evaluate", "--episodes", 10**9, "--episodes-csv", tmp_path / "a.csv")
    assert_one_clear_line(done, "a.csv: found a folder")


OPTIONS = {
    "planar": (("--planar",), {"planar": True}),
    "odometry": (("--odometry",), {"odometry": True}),
    "time step": (("--dt", "0.5"), {"dt": 0.5}),
    "reward": (("--reward", "log-score"), {"reward": "log-score"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("option", OPTIONS)
def test_an_option_means_the_same_as_the_argument_of_the_environment(option, tmp_path):
    words, arguments = OPTIONS[option]
    steps = ("--policy", "fixed-ukf", "--episodes", 1, "--seed", 3, "--episode-steps", 30)
    succeed("evaluate", *steps, *words, "--json", tmp_path / "one.json")
    env = gymnasium.make("MmWaveLoc-v0", episode_steps=30, **arguments)
    env.reset(seed=3)
    rewards, info = [], {}
    while len(rewards) < 30:
        _, reward, *_, info = env.step(1)
        rewards.append(reward)
    row = json.loads((tmp_path / "one.json").read_text())["policies"]["fixed-ukf"]
    assert row["reward"]["mean"] == pytest.approx(np.mean(rewards[BURN_IN:]))
    for metric in ("ate_m", "rmse_m", "rpe_m", "nees", "in_bounds"):
        assert row[metric]["mean"] == pytest.approx(info[INFO_KEYS[metric]]), metric
