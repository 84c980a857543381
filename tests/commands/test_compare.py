"""Tests of ``mmwave-loc compare`` and ``evaluate`` with learned policies and training runs."""

import json
import re

import pytest

from tests.cli import assert_one_clear_line, command, succeed
from tests.training.actors import actor, card_of, write


@pytest.fixture
def run(tmp_path):
    """Return a folder as ``mmwave-loc train`` writes it, with policies of random weights."""
    folder = tmp_path / "run"
    for seed in range(3):
        (folder / f"seed-{seed}").mkdir(parents=True)
        write(folder / f"seed-{seed}" / "policy.safetensors", actor(seed=seed), card_of())
    summary = {"seeds": [{"seed": seed} for seed in (2, 0, 1)], "median": 0}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.mark.slow
def test_comparing_a_run_gives_results_for_each_training_seed(run, tmp_path):
    policies = (run, run / "seed-1" / ".." / "seed-1" / "policy.safetensors", "fixed-ukf", "imm")
    median, single, *_ = names = [str(policy) for policy in policies]
    file = tmp_path / "all.json"
    shown = succeed("compare", "--policies", *policies, "--episodes", 12, "--json", file)
    result = json.loads(file.read_text())
    assert list(result["policies"]) == names
    references = ("fixed-ukf", "imm")
    pairs = [f"{n} - {r}" for r in references for n in names if n != r]
    assert list(result["paired"]) == [*pairs, f"{single} - {median}", f"{median} - {single}"]

    (seeds,) = result["training_seeds"].values()
    assert list(result["training_seeds"]) == [median] and seeds["median"] == 0
    for seed, name in (("0", median), ("1", single)):
        alone = result["policies"][name]["reward"]
        assert seeds["reward"]["seeds"][seed]["mean"] == pytest.approx(alone["mean"])
    for rival in references:
        row = seeds["minus"][rival]
        assert list(row) == ["seeds", "above_zero", "mean"]
        assert list(row["seeds"]) == ["2", "0", "1"]
        paired = result["paired"][f"{median} - {rival}"]["reward"]
        assert row["seeds"]["0"]["ci95"] == pytest.approx(paired["ci95"])
    assert "| 0 (median) |" in shown and "minus imm (best IMM)" in shown


@pytest.mark.slow
def test_a_policy_is_evaluated_from_its_file_or_from_its_run(run, tmp_path):
    files = [tmp_path / "file.json", tmp_path / "run.json"]
    alone = run / "seed-0" / "policy.safetensors"
    shown = succeed("evaluate", "--policy", alone, "--episodes", 2, "--json", files[0])
    assert f"| {alone} |" in shown
    shown = succeed("evaluate", "--policy", run, "--episodes", 2, "--json", files[1])
    assert f"| {run} |" in shown
    by_file, by_run = (json.loads(file.read_text()) for file in files)
    assert [*by_file["policies"].values()] == [*by_run["policies"].values()]
    assert "training_seeds" not in by_file and by_run["training_seeds"][str(run)]["minus"] == {}


def truncated(run):
    path = run / "seed-1" / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:1000])


def without_a_policy(run):
    (run / "seed-2" / "policy.safetensors").unlink()


MISTAKES = {
    "a truncated policy": (truncated, (), r"seed-1/policy.safetensors: not a policy file"),
    "a missing policy": (without_a_policy, (), r"seed-2/policy.safetensors: found no such file"),
    "a damaged summary": (
        lambda run: (run / "summary.json").write_text("[]"), (), "summary.json: not the summary",
    ),
    "no summary": (
        lambda run: (run / "summary.json").unlink(), (), "summary.json: found no file.*--resume",
    ),
    "the run twice": (None, ("RUN/",), "policies: found .*expected different names"),
    "no folder": (None, ("runs/never",), "policy: found 'runs/never', expected.*imm.*of a run"),
    "no file": (None, ("never.safetensors",), "never.safetensors: found no such file"),
    "not a picture": (None, ("--errors", "f.gif"), "found f.gif.*ends with .png, .svg, .pdf"),
    "not a LaTeX file": (None, ("--table", "t.md"), r"table: found t.md.*ends with \.tex"),
    "too narrow": (None, ("--width-mm", "10"), "width_mm: found 10, expected 80 to 500"),
    "one file for two pictures": (
        None, ("--errors", "f.png", "--consistency", "f.png"), "consistency: .*f.png.*other than",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_with_one_clear_line(run, tmp_path, mistake):
    damage, words, message = MISTAKES[mistake]
    if damage:
        damage(run)
    paths = {"f.png": str(tmp_path / "f.png"), "RUN/": f"{run}/"}
    words = [paths.get(word, word) for word in words]
    done = command("compare", "--episodes", "1", "--policies", run, *words)
    assert_one_clear_line(done, f"^mmwave-loc compare: .*{message}")


@pytest.mark.slow
def test_one_comparison_can_draw_both_errors_and_consistency(tmp_path):
    pictures = [tmp_path / "errors.svg", tmp_path / "nees.pdf"]
    files = ("--errors", pictures[0], "--consistency", pictures[1], "--width-mm", 90)
    table = tmp_path / "table.tex"
    succeed("compare", "--policies", "fixed-ukf", "imm", "--episodes", 3, *files, "--table", table)
    width_pt = float(re.search(r'width="([\d.]+)pt"', pictures[0].read_text())[1])
    assert width_pt == pytest.approx(90 / 25.4 * 72, abs=0.01)
    assert pictures[1].read_bytes().startswith(b"%PDF")
    lines = table.read_text().splitlines()
    assert lines[0].startswith(r"\begin{tabular}") and lines[-1] == r"\end{tabular}"
    assert {len(re.split(r"(?<!\\)&", line)) for line in lines if line.endswith(r"\\")} == {8}
