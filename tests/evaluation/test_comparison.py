"""Tests of comparisons: which policies are paired, their differences, scores and error tables."""

import numpy as np
import pytest

from experiments.evaluation.compare import Comparison, compare_scores
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.positions import HEADER, percent, positions_markdown
from mmwave_env.localization.position_errors import PositionErrors
from mmwave_env.metrics import HEADERS, METRICS, TERMS


def scores(**rewards):
    """Return metrics of contenders (policies): rewards, and their multiples as other metrics."""
    return {
        name.replace("_", "-"): {
            metric: (i + 1.0) * np.asarray(reward, float)
            for i, metric in enumerate((*METRICS, *TERMS))
        }
        for name, reward in rewards.items()
    }


SETTING = {"scenario": "mixed", "radio": "handset", "seeds": range(3)}


def test_contenders_are_paired_with_references_but_users_agents_are_paired_with_all():
    """Check that the references are the best fixed mode, the speed rule and the IMMs."""
    table = scores(mine=[0, 1], yours=[3, 3], guided=[1, 3], imm_best=[2, 2], speed_rule=[1, 1])
    table |= scores(fixed_ekf=[0, 0], fixed_ukf=[1, 0])
    comparison = compare_scores(table, ["mine", "yours"], **SETTING)
    best = ("fixed-ukf", "speed-rule", "imm-best")
    references = [(a, b) for b in best for a in table if a != b]
    own = [("yours", "mine"), ("mine", "yours")]
    own += [(a, b) for b in ("guided", "fixed-ekf") for a in ("mine", "yours")]
    assert list(comparison.paired) == [f"{a} - {b}" for a, b in references + own]


def test_a_stored_comparison_keeps_the_kind_of_its_reward():
    table = scores(mine=[0, 1], imm_best=[2, 2])
    comparison = compare_scores(table, ["mine"], reward="log-score", **SETTING)
    stored = Comparison.from_json(comparison.json)
    assert stored.reward == "log-score"
    assert "reward log-score" in str(stored)


def test_without_a_reference_all_contenders_are_compared_with_each_other():
    table = scores(mine=[0, 1], yours=[1, 3], guided=[2, 2])
    table["runs/a - b"] = table.pop("yours")
    comparison = compare_scores(table, ["mine"], **SETTING)
    assert set(comparison.paired) == {f"{a} - {b}" for a in table for b in table if a != b}
    assert comparison.paired["runs/a - b - mine"]["reward"].mean == pytest.approx(1.5)
    (header,) = [line for line in str(comparison).splitlines() if line.startswith("| reward of")]
    assert header == "| reward of | minus mine | minus guided | minus runs/a - b |"
    assert not compare_scores(scores(mine=[0, 1]), **SETTING).paired


def test_paired_differences_are_taken_episode_by_episode():
    rng = np.random.default_rng(0)
    hardness = rng.normal(0.0, 10.0, 40)  # the same for both contenders
    table = scores(speed_rule=hardness, ppo=hardness - 1.0 + 0.01 * rng.normal(size=40))
    result = compare_scores(table, **SETTING)
    assert list(result.paired) == ["ppo - speed-rule"]
    difference = table["ppo"]["ate_m"] - table["speed-rule"]["ate_m"]
    (expected,) = bootstrap([difference])
    gain = result.paired["ppo - speed-rule"]["ate_m"]
    assert gain.mean == pytest.approx(difference.mean())
    assert (gain.low, gain.high) == pytest.approx((expected.low, expected.high))


def test_the_speed_rule_has_score_0_and_the_clairvoyant_has_score_100():
    table = scores(mine=[-1, -2], speed_rule=[-3, -4], clairvoyant=[1, 0], worse=[-5, -4])
    result = compare_scores(table, **SETTING)
    assert result.scores == {"mine": 50.0, "speed-rule": 0.0, "clairvoyant": 100.0, "worse": -25.0}
    header, rows = result.table()
    assert header[-1] == "score" and [row[-1] for row in rows] == ["50", "0", "100", "-25"]
    del table["clairvoyant"]
    assert "score" not in str(compare_scores(table, **SETTING))


@pytest.mark.parametrize(
    ("share", "shown"),
    [(None, "-"), (0.0, "0.0 %"), (0.0123, "1.2 %"), (0.00089, "0.089 %"), (0.9988, "99.88 %")],
)
def test_percentages_have_more_decimals_close_to_0_or_100(share, shown):
    assert percent(share) == shown


def test_a_table_of_errors_has_a_row_for_each_direction_even_without_errors():
    table = positions_markdown("policy", {"a|b": PositionErrors().figures()}, 1e-3, "gaussian")
    header, _, *rows = table.splitlines()[:4]
    assert header == f"| policy | {' | '.join(HEADER)} |" and not set(HEADER) & {*HEADERS.values()}
    cells = " | -" * len(HEADER)
    assert rows == [rf"| a\|b, horizontal{cells} |", rf"| a\|b, vertical{cells} |"]
