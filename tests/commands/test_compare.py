"""Tests of ``mmwave-loc compare``, and of ``mmwave-loc demo``.

Policies may be given as files, or as *runs*, which are folders that ``mmwave-loc train`` wrote.
"""

import gymnasium
import numpy as np
import pytest

from experiments import demo
from experiments.evaluation.compare import compare_scores
from experiments.evaluation.contenders import contenders
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.positions import EpochErrors
from experiments.reporting.comparison_results import over_training_seeds
from mmwave_env.metrics import BURN_IN, INFO_KEYS, METRICS, TERMS
from tests.cli import assert_refused, succeed, with_json
from tests.paths import ROOT, json_in, records, write_json
from tests.training.actors import actor, card_of, write


@pytest.fixture
def run(tmp_path):
    """Return the folder of a run with three training seeds; its policies have random weights."""
    folder = tmp_path / "run"
    for seed in range(3):
        (folder / f"seed-{seed}").mkdir(parents=True)
        write(folder / f"seed-{seed}" / "policy.safetensors", actor(seed=seed), card_of())
    summary = {"seeds": [{"seed": seed} for seed in (2, 0, 1)], "median": 0}
    write_json(folder / "summary.json", summary)
    return folder


@pytest.mark.slow
def test_comparing_a_run_gives_results_over_its_training_seeds(run):
    policies = (run, run / "seed-1" / ".." / "seed-1" / "policy.safetensors", "fixed-ukf", "imm")
    median, single, *_ = names = [str(policy) for policy in policies]
    shown, result = with_json("compare", "--policies", *policies, "--episodes", 12)
    assert list(result["policies"]) == names
    references = ("fixed-ukf", "imm")
    pairs = [f"{n} - {r}" for r in references for n in names if n != r]
    assert list(result["paired"]) == [*pairs, f"{single} - {median}", f"{median} - {single}"]

    assert list(result["training_seeds"]) == [median]
    assert list(result["training_seeds"][median]) == ["reward", "minus fixed-ukf", "minus imm"]
    assert "| mean over seeds |" in shown and "| minus imm |" in shown


POLICY = "seed-2/policy.safetensors"
MISTAKES = {  # name -> file to remove from the run, more policies or options, expected message
    "a missing policy": (POLICY, (), f"{POLICY}: found no such file"),
    "no summary": ("summary.json", (), "summary.json: found no file.*--resume"),
    "the run twice": (None, ("RUN/",), "policies: found .*expected different names"),
    "no such run": (None, ("runs/never",), "policy: found 'runs/never', expected.*imm.*of a run"),
    "not a picture": (None, ("--errors", "f.gif"), "found f.gif.*ends with .png, .svg, .pdf"),
    "results over the radio": (
        None, ("--radio", "r.json", "--json", "r.json"), "json: .*r.json.* than for radio",
    ),
    "one file for two pictures": (
        None, ("--errors", "f.png", "--consistency", "f.png"), "errors: .*f.png.* than for consist",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_with_one_clear_line(run, tmp_path, mistake):
    removed, words, message = MISTAKES[mistake]
    if removed:
        (run / removed).unlink()
    paths = {"f.png": str(tmp_path / "f.png"), "RUN/": f"{run}/"}
    words = [paths.get(word, word) for word in words]
    assert_refused(
        f"^mmwave-loc compare: .*{message}", "compare", "--episodes", "1", "--policies", run, *words
    )


@pytest.mark.slow
def test_one_comparison_can_draw_both_errors_and_consistency(tmp_path):
    pictures = [tmp_path / "errors.svg", tmp_path / "nees.pdf"]
    files = ("--errors", pictures[0], "--consistency", pictures[1])
    succeed("compare", "--policies", "fixed-ukf", "imm", "--episodes", 3, *files)
    assert "95 %" in pictures[0].read_text()
    assert pictures[1].read_bytes().startswith(b"%PDF")


# --- results and options

SCHEMA = json_in(ROOT / "mmwave_env/data/schemas/results.schema.json")
POLICIES = ("fixed-ekf", "fixed-ukf")
TWO = ("--policies", *POLICIES, "--episodes", 2, "--episode-steps", 15, "--seed", 4)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return the JSON content and the CSV rows of a comparison."""
    table = tmp_path_factory.mktemp("results") / "r.csv"
    _, content = with_json("compare", *TWO, "--episodes-csv", table)
    return content, records(table)


@pytest.mark.slow
def test_results_of_one_episode_match_the_schema_without_intervals():
    _, alone = with_json("compare", "--episodes", 1, "--episode-steps", 15)
    assert alone["policies"]["speed-rule"]["reward"]["ci95"] is None
    pytest.importorskip("jsonschema").validate(alone, SCHEMA)


def test_the_option_percentiles_adds_percentiles_to_the_printed_tables_and_to_json(results):
    assert "position_errors" not in results[0]
    shown, content = with_json("compare", *TWO, "--percentiles")
    pytest.importorskip("jsonschema").validate(content, SCHEMA)
    errors = content.pop("position_errors")
    assert "--percentiles" in content["command"]
    assert content | {"command": ""} == results[0] | {"command": ""}
    assert errors["risk"] == 1e-3 and tuple(errors["policies"]) == POLICIES
    lines = shown.splitlines()
    for name, kinds in errors["policies"].items():
        for kind, figures in kinds.items():
            (row,) = [line for line in lines if line.startswith(f"| {name}, {kind} |")]
            assert f" {figures['percentiles_m']['95']:#.3g} |" in row
            assert figures["epochs"] == 2 * (15 - BURN_IN)
    assert "at a risk of 0.001" in shown


def test_the_csv_of_episodes_has_a_row_with_an_episode_key_for_every_policy_and_seed(results):
    content, rows = results
    assert list(rows[0]) == ["policy", "seed", "key", *METRICS, *TERMS]
    env = gymnasium.make("MmWaveLoc-v0", episode_steps=15)
    keys = {str(seed): str(env.reset(seed=seed)[1]["episode_key"]) for seed in (4, 5)}
    assert [(row["policy"], row["seed"], row["key"]) for row in rows] == [
        (name, seed, key) for name in POLICIES for seed, key in keys.items()
    ]
    for name in POLICIES:
        for metric, interval in content["policies"][name].items():
            values = [float(row[metric]) for row in rows if row["policy"] == name]
            assert np.mean(values) == pytest.approx(interval["mean"])


def test_recorded_episodes_have_seeds_but_no_episode_keys(tmp_path):
    where = ("--data", "canyon28_vehicle", "--episode-steps", 15, "--episodes", 2)
    words = ("compare", "--policies", "fixed-ukf", *where, "--episodes-csv", tmp_path / "r.csv")
    _, content = with_json(*words)
    rows = records(tmp_path / "r.csv")
    assert [(row["seed"], row["key"]) for row in rows] == [("0", ""), ("1", "")]
    assert content["scenario"] == "canyon28_vehicle" and list(content["policies"]) == ["fixed-ukf"]


def test_a_table_that_cannot_be_written_is_refused_before_episodes_are_played(tmp_path):
    (tmp_path / "a.csv").mkdir()
    assert_refused(
        "a.csv: found a folder",
        "compare",
        "--episodes",
        10**9,
        "--episodes-csv",
        tmp_path / "a.csv",
    )


@pytest.mark.slow
def test_options_mean_the_same_as_the_arguments_of_the_environment():
    words = ("--planar", "--odometry", "--dt", "0.5", "--reward", "log-score")
    arguments = {"planar": True, "odometry": True, "dt": 0.5, "reward": "log-score"}
    steps = ("--policies", "fixed-ukf", "--episodes", 1, "--seed", 3, "--episode-steps", 30)
    _, content = with_json("compare", *steps, *words)
    env = gymnasium.make("MmWaveLoc-v0", episode_steps=30, **arguments)
    env.reset(seed=3)
    rewards = []
    info = {}
    while len(rewards) < 30:
        _, reward, *_, info = env.step(1)
        rewards.append(reward)
    row = content["policies"]["fixed-ukf"]
    assert row["reward"]["mean"] == pytest.approx(np.mean(rewards[BURN_IN:]))
    for metric in ("ate_m", "rmse_m", "rpe_m", "nees", "in_bounds"):
        assert row[metric]["mean"] == pytest.approx(info[INFO_KEYS[metric]]), metric


# --- the results of a run (one policy per training seed): differences and intervals

RUN = "runs/a"
OTHER = "runs/b"
EPISODES = 40


def rewards(seed, *shape):
    return np.random.default_rng(seed).normal(size=(*shape, EPISODES))


@pytest.fixture(scope="module")
def trained():
    """Return rewards (seeds, episodes) of two runs, of which the second is better."""
    return {RUN: rewards(10, 3), OTHER: rewards(11, 4) + 9.0}


def test_differences_are_paired_by_episode(trained):
    names = ("fixed-ekf", "fixed-ukf", "speed-rule", "ppo", "imm", "imm-best")
    scores = {name: {"reward": rewards(i)} for i, name in enumerate(names)}
    scores["fixed-ukf"]["reward"] += 2.0
    scores["imm-best"]["reward"] += 5.0
    compared = {
        name: over_training_seeds(name, [{"reward": each} for each in rewards], scores)[0]
        for name, rewards in trained.items()
    }
    for name, content in compared.items():
        gains = [f"minus {rival}" for rival in ("fixed-ukf", "speed-rule", "imm", "imm-best")]
        assert list(content) == ["reward", *gains]
        for gain in gains:
            differences = trained[name] - scores[gain.removeprefix("minus ")]["reward"]
            assert content[gain]["above_zero"] == sum(i.low > 0.0 for i in bootstrap(differences))
            mean = Interval.of(content[gain]["mean"])
            assert mean.mean == pytest.approx(differences.mean())
            assert mean.low < mean.mean < mean.high
    assert [content["minus imm-best"]["above_zero"] for content in compared.values()] == [0, 4]


def test_a_run_without_rivals_still_has_its_reward(trained):
    rewards = [{"reward": reward} for reward in trained[RUN]]
    alone, table = over_training_seeds(RUN, rewards, {RUN: rewards[1]})
    assert [*alone] == ["reward"]
    assert alone["reward"]["mean"]["mean"] == pytest.approx(trained[RUN].mean())
    assert "| mean over seeds | " in table


# --- demo


def test_demo_prints_and_writes_results_for_every_data_set(tmp_path, monkeypatch, capsys):
    everyone = [*contenders("handset")]

    def results(args):
        assert args.percentiles and not args.policies
        scores = {name: dict.fromkeys((*METRICS, *TERMS), np.arange(3.0)) for name in everyone}
        episodes = {"scenario": args.data or "mixed", "seeds": range(args.episodes)}
        comparison = compare_scores(scores, radio=args.radio, **episodes)
        return comparison, str(comparison), comparison.json, EpochErrors()

    def page_of(args):
        assert args.results == tuple(tmp_path / f"{data}.json" for data in data_sets)
        return "a page"

    data_sets = ["mixed", "canyon28_pedestrian", "canyon28_vehicle"]
    monkeypatch.setattr("experiments.reporting.comparison_results.results", results)
    monkeypatch.setattr("experiments.reporting.webpage.page.page_of", page_of)
    demo.main(demo.Args(out=tmp_path, percentiles=True))
    shown = capsys.readouterr().out
    assert "Paired" not in shown and str(tmp_path / "tables.md") in shown
    written = (tmp_path / "tables.md").read_text()
    assert all(written.count(f"\n| {name} |") == 2 * len(data_sets) for name in everyone)
    assert all(shown.count(f"\n| {name} |") == len(data_sets) for name in everyone)
    (page,) = tmp_path.glob("*.html")
    assert str(page) in shown and page.read_text() == "a page"
    for data in data_sets:
        assert str(tmp_path / f"{data}.json") in shown
        assert list(json_in(tmp_path / f"{data}.json")["policies"]) == everyone
