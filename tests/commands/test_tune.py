"""Tests that tuning recovers the noise of simulated data, finds the shipped modes, and searches."""

import shlex
from dataclasses import fields, replace

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.training.tuning import START, best_bank_of, objective_of, search_space, tune
from mmwave_env.filters import Mode
from mmwave_env.filters.bank import bank_from, best_bank, read_bank
from mmwave_env.filters.imm import stay_matrix
from mmwave_env.models.radio import RADIOS, TUNED_RADIOS
from mmwave_env.world.keys import draw_key
from tests.cli import assert_refused, succeed
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
        (
            ["--radio", "my.json", "--out", "my.json"],
            "out: found .*my.json, expected another file than for radio",
        ),
    ],
)
def test_a_mistake_ends_with_one_clear_line(options, message):
    assert_refused(message, "tune", *options)


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


# --- the search for the best bank (the modes of an IMM and their transition matrix)


def distance(bank, planted):
    """Return the sum of squared differences between the logarithms of two banks' parameters."""
    pairs = [(np.array(bank.transition), np.array(planted.transition))]
    for field in ("sigma_p", "sigma_v", "acceleration_mps2"):
        values = [[getattr(mode, field) for mode in bank_of.modes] for bank_of in (bank, planted)]
        pairs.append((np.abs(values[0]) + 1e-3, np.abs(values[1]) + 1e-3))
    return float(sum(np.square(np.log(a / b)).sum() for a, b in pairs))


@pytest.mark.slow
def test_the_search_finds_a_planted_bank():
    """Score each bank by its closeness to a random bank, which is planted near the start."""
    space = search_space(START[:3])
    away = np.random.default_rng(0).standard_normal(len(space.start))
    planted = space.bank_at(space.start + 0.7 * space.deviation * away)

    def closeness(bank, _):
        return -distance(bank, planted)

    start = best_bank_of(space, closeness, 0)
    best = best_bank_of(space, closeness, 3000)
    assert distance(best, planted) < 0.02 * distance(start, planted)


def test_generations_are_numbered_and_the_number_of_evaluations_is_limited():
    asked = []

    def value(bank, generation):
        asked.append(generation)
        return 0.0

    best_bank_of(search_space(START[1:3]), value, 40)
    size = asked.count(0)
    assert asked == [i // size for i in range(len(asked))]
    assert 40 - size < len(asked) <= 40


def test_the_search_starts_from_the_modes_and_varies_every_parameter():
    space = search_space(START)
    n = len(START)
    start = space.bank_at(space.start)
    assert start.modes == START and start.nis_quantile == 0.999
    assert_allclose(start.transition, stay_matrix(n), atol=1e-5)
    maneuvers = sum(bool(mode.acceleration_mps2) for mode in START)
    assert len(space.start) == n * (n - 1) + 2 * n + maneuvers + 1
    for i, deviation in enumerate(space.deviation):
        moved = space.start.copy()
        moved[i] += deviation
        assert space.bank_at(moved) != start


@pytest.mark.parametrize("radio", TUNED_RADIOS)
def test_shipped_banks_differ_from_the_start_only_in_searched_parameters(radio):
    for before, after in zip(START, best_bank(radio).modes, strict=True):
        free = {"sigma_p", "sigma_v", "acceleration_mps2"}
        fixed = {f.name: getattr(before, f.name) for f in fields(before) if f.name not in free}
        assert fixed == {name: getattr(after, name) for name in fixed}
