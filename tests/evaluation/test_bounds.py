"""mmwave-loc compare --bound, as it is typed, and the figures behind it."""

import json

import numpy as np
import pytest

from experiments.evaluation.bounds import bounds_of, over_bound
from experiments.evaluation.contenders import contender_from
from experiments.evaluation.cramer_rao import (
    averaged_bound,
    conditional_bounds,
    measured_motion,
    position_variance,
)
from experiments.evaluation.intervals import RESAMPLES
from experiments.evaluation.runner import score
from experiments.evaluation.seeds import Selection, draw_episodes
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.simulated import SimulatedSource
from tests.cli import succeed

RADIO = RADIOS["handset"]
STREET = SCENES["street"]


def test_compare_shows_policies_over_the_bound(tmp_path):
    file, policies = tmp_path / "compare.json", ("fixed-ukf", "imm")
    shown = succeed("compare", "--bound", "--episodes", 6, "--policies", *policies, "--json", file)
    assert "| policy | RMSE m | over averaged bound | over conditional bound |" in shown
    assert "not strict" in shown and "blockage" in shown
    result = json.loads(file.read_text())
    bound = result["bound"]
    assert list(result) == [
        "command", "options", "versions", "scenario", "radio", "episodes", "seed", "policies",
        "paired", "bound",
    ]  # fmt: skip
    assert list(bound["policies"]) == list(policies)
    episodes = draw_episodes(SimulatedSource(STREET, RADIO), range(6))
    assert list(bound["sigma_v"]) == list(dict.fromkeys(e.name for e in episodes))
    assert 0.0 < bound["averaged_m"] < bound["conditional_m"]
    for row in bound["policies"].values():
        for column, base in (
            ("averaged", bound["averaged_m"]),
            ("conditional", bound["conditional_m"]),
        ):
            over, rmse = row[f"over_{column}"], row["rmse_m"]
            assert over["mean"] == pytest.approx(rmse["mean"] / base)
            assert over["ci95"] == pytest.approx([edge / base for edge in rmse["ci95"]])
            assert over["ci95"][0] <= over["mean"] <= over["ci95"][1]


@pytest.mark.slow
def test_recorded_data_has_a_bound_and_without_the_option_none_is_shown(tmp_path):
    file = tmp_path / "compare.json"
    options = ("--data", "canyon28_vehicle", "--policies", "fixed-ukf", "imm", "--episodes", 2)
    succeed("compare", *options, "--bound", "--json", file)
    bound = json.loads(file.read_text())["bound"]
    assert list(bound["sigma_v"]) == ["canyon28_vehicle"]
    # One track: both bounds are one number, up to rounding.
    assert 0.0 < bound["averaged_m"] == pytest.approx(bound["conditional_m"], rel=1e-12)
    assert "bound |" not in succeed("compare", *options, "--json", file)
    assert "bound" not in json.loads(file.read_text())


def root_mean_square(bound):
    return np.sqrt(position_variance(bound)[..., BURN_IN:].mean())


def test_every_kind_has_the_bound_of_its_own_motion():
    walk = draw_episodes(SimulatedSource(STREET, RADIO, "pedestrian", epochs=40), range(4))
    drive = draw_episodes(SimulatedSource(STREET, RADIO, "vehicle", epochs=40), range(12))
    kinds = []
    for episodes in (walk, drive):
        alone, motion = bounds_of(episodes, RADIO.drift_mps), measured_motion(episodes, 0.05)
        assert alone.averaged_m == pytest.approx(root_mean_square(averaged_bound(episodes, motion)))
        conditional = root_mean_square(conditional_bounds(episodes, motion))
        assert alone.conditional_m == pytest.approx(conditional)
        kinds.append(alone)
    both = bounds_of([*drive, *walk], RADIO.drift_mps)
    for name in ("averaged_m", "conditional_m"):
        slow, fast = (getattr(kind, name) for kind in kinds)
        pooled = np.sqrt((4 * slow**2 + 12 * fast**2) / 16)
        assert getattr(both, name) == pytest.approx(pooled)
    assert both.sigma_v == kinds[0].sigma_v | kinds[1].sigma_v
    assert both.sigma_v["pedestrian"]["horizontal"] < both.sigma_v["vehicle"]["horizontal"]
    assert both.sigma_v["vehicle"]["vertical"] == 0.0  # flat ground


def test_bounds_are_those_of_the_episodes_that_were_scored():
    source = SimulatedSource(STREET, RADIO, epochs=40)
    episodes = draw_episodes(source, range(7, 12))
    contender = contender_from("imm", RADIO.name)
    scores = {"imm": score(contender, contender.start(source.layout), episodes)}
    over = over_bound(scores, source, RADIO, Selection(range(7, 12)))
    assert over.bounds == bounds_of(episodes, RADIO.drift_mps)
    squared = np.square(scores["imm"]["rmse_m"])
    pooled = over.policies["imm"]["rmse_m"]
    assert pooled.mean == pytest.approx(np.sqrt(squared.mean()))
    resampled = np.random.default_rng(1).choice(squared, (RESAMPLES, len(squared))).mean(axis=1)
    expected = np.sqrt(np.percentile(resampled, [2.5, 97.5]))
    assert (pooled.low, pooled.high) == pytest.approx(expected, rel=0.1)
