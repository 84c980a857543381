"""Tests that tuning recovers the noise of simulated data and reproduces the shipped modes."""

import shlex
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from experiments.training.tuning import objective_of, tune
from mmwave_env.filters import Mode
from mmwave_env.filters.bank import bank_from, read_bank
from mmwave_env.models.radio import RADIOS
from mmwave_env.world.keys import draw_key
from tests.cli import assert_one_clear_line, command, succeed
from tests.filters.tracks import far_from_the_anchors, process_noise, street_source
from tests.paths import ROOT, json_in

MODES = ROOT / "mmwave_env" / "data" / "modes"
SHIPPED = sorted(file for radio in RADIOS for file in MODES.glob(f"{radio}*.json"))
PLAIN = Mode("own", "ekf", gate=None, recovery=None, adaptive=False)


def test_tuning_finds_the_noise_that_made_the_data():
    made_by = replace(PLAIN, sigma_v=0.8)
    model = far_from_the_anchors(process_noise(made_by))
    rng = np.random.default_rng(0)
    episodes = [model.draw(rng, 120) for _ in range(48)]
    best = tune(PLAIN, ["sigma_v"], objective_of(PLAIN, episodes))
    assert best.sigma_v == pytest.approx(0.8, rel=0.05)
    assert (best.sigma_p, best.algorithm) == (PLAIN.sigma_p, "ekf")


@pytest.mark.slow
def test_the_command_writes_a_mode_file_that_environments_and_commands_accept(tmp_path):
    modes = tmp_path / "modes.json"
    options = ["--modes", "ekf", "ukf-robust", "--scenarios", "pedestrian", "jam", "--episodes", 3,
               "--free", "sigma_v", "spread_gain", "--diagonal"]  # fmt: skip
    shown = succeed("tune", *options, "--out", modes)
    ekf, robust = read_bank(modes).modes
    assert not ekf.coupling and ekf.adaptive and robust.robust and robust.spread_gain > 0.0
    assert shown.startswith("ekf on pedestrian, handset: ") and "ukf-robust on jam" in shown
    assert f": sigma_v {ekf.sigma_v:g}, spread_gain {ekf.spread_gain:g}" in shown
    env = gym.make("mmwave_env:MmWaveLoc-v0", modes=str(modes))
    assert env.unwrapped.modes == (ekf, robust)
    words = ("--modes", modes, "--policies", "fixed-ukf-robust", "--episodes", 2)
    assert "fixed-ukf-robust" in succeed("compare", *words)


@pytest.mark.slow
def test_a_tuned_bank_of_modes_is_written_with_its_results_on_held_out_episodes(tmp_path):
    options = ["--bank", "--radio", "high", "--episodes", 18, "--evaluations", 30]
    shown = succeed("tune", *options, "--out", tmp_path / "bank.json")
    written = json_in(tmp_path / "bank.json")
    assert sorted(shlex.split(written["command"])[2:]) == sorted(map(str, options))
    assert len(bank_from(tmp_path / "bank.json").modes) == 5
    low, high = written["held_out"]["minus imm"]["ci95"]
    assert low <= written["held_out"]["minus imm"]["mean"] <= high
    assert f"reward {written['held_out']['reward']['mean']:.3f}" in shown


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seed", "999"], "seed: found 999, expected a tuning seed >= 5000000"),
        (["--scenarios", "vehicle"], "scenarios: found 1, expected 2, one for each.*ekf, ukf"),
        (["--free", "gate"], "free: found 'gate', expected one of sigma_p, sigma_v"),
        (["--free", "sigma_v", "sigma_v"], "free: .*different names"),
        (["--bank", "--episodes", "12"], "expected 3 or more, 18"),
        (["--bank", "--free", "sigma_v"], "free: cannot be combined with --bank"),
        (["--radio", "my.json", "--out", "my.json"], "out: found my.json, which is the radio"),
    ],
)
def test_a_mistake_ends_with_one_clear_line(options, message):
    assert_one_clear_line(command("tune", *options), message)


def marked(file):
    """Mark a file, unless it is handset.json, so that only the tests for a release use it."""
    return file if file.stem == "handset" else pytest.param(file, marks=pytest.mark.release)


@pytest.mark.slow
@pytest.mark.parametrize("file", [*map(marked, SHIPPED)], ids=lambda file: file.stem)
def test_tuning_on_the_original_episodes_finds_the_shipped_modes(file):
    """Draw the keys of the episodes on which the shipped modes were tuned, and tune again."""
    seeds = range(5_000_000, 5_000_300)
    keys = np.array([draw_key(np.random.default_rng(seed)) for seed in seeds], np.uint64)
    radio = file.stem.removesuffix("-diagonal")
    for scenario, shipped in zip(("pedestrian", "vehicle"), read_bank(file).modes, strict=True):
        source = street_source(scenario, radio)
        objective = objective_of(shipped, source.episodes(keys))
        made = tune(shipped, ["sigma_v", "sigma_p"], objective)
        # The optimum is flat: modes with slightly different sigma_v fit the episodes equally well.
        assert objective(shipped).mean() == pytest.approx(objective(made).mean(), abs=0.002)
        assert made.sigma_v == pytest.approx(shipped.sigma_v, rel=0.05)
