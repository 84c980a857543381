"""The evaluation protocol: the same episodes for all, paired, with bootstrap intervals."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import bootstrap as scipy_bootstrap
from scipy.stats import norm

import mmwave_env  # noqa: F401  registers the environment
from experiments import evaluation
from experiments.comparison import compare, references
from experiments.evaluation import (
    contender_from,
    contenders,
    draw_episodes,
    evaluate,
    score,
)
from experiments.intervals import RESAMPLES, bootstrap, bootstrap_ratio
from mmwave_env.estimator.modes import modes_from
from mmwave_env.metrics import METRICS
from mmwave_env.radio import RADIOS
from mmwave_env.scene import SCENES
from mmwave_env.simulation import SimulatedSource
from policies import FixedMode

# Estimates of a lost track can be fast; the rule's own test looks at the warning.
pytestmark = pytest.mark.filterwarnings("ignore:speed .* outside the design window")

SOURCE = SimulatedSource(SCENES["street"], RADIOS["handset"])


# --- bootstrap


@pytest.mark.parametrize("n", [5, 60])
def test_intervals_agree_with_scipy_s_bootstrap(n):
    values = np.random.default_rng(0).exponential(2.0, (n, 2))
    found = bootstrap(values)
    # Monte-Carlo error of a 2.5 % quantile from R resamples of a nearly normal mean, in
    # standard errors of the mean; 4.5 of those for the difference of two is 1 in 10^5.
    quantile_error = np.sqrt(0.025 * 0.975 / RESAMPLES) / norm.pdf(norm.ppf(0.025))
    for column, interval in zip(values.T, found, strict=True):
        other = scipy_bootstrap(
            (column,), np.mean, n_resamples=RESAMPLES, method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
        margin = 4.5 * np.sqrt(2.0) * quantile_error * column.std() / np.sqrt(n)
        assert interval.mean == pytest.approx(column.mean())
        assert abs(interval.low - other.low) <= margin
        assert abs(interval.high - other.high) <= margin


def test_columns_share_their_resamples():
    column = np.random.default_rng(0).normal(size=40)
    plain, shifted, doubled = bootstrap(np.column_stack([column, column + 3.0, 2.0 * column]))
    assert shifted.low == pytest.approx(plain.low + 3.0)
    assert doubled.high == pytest.approx(2.0 * plain.high)


def test_intervals_are_repeatable_and_of_one_episode_a_point():
    values = np.random.default_rng(0).normal(size=(30, 1))
    assert bootstrap(values) == bootstrap(values) != bootstrap(values, seed=1)
    (single,) = bootstrap(np.array([[2.5]]))
    assert (single.mean, single.low, single.high) == (2.5, 2.5, 2.5)


# --- comparisons


def scores(**rewards):
    """Scores of contenders with the given rewards; the other metrics follow from them."""
    return {
        name.replace("_", "-"): {
            metric: (i + 1.0) * np.asarray(reward, float) for i, metric in enumerate(METRICS)
        }
        for name, reward in rewards.items()
    }


WHAT = {"scenario": "mixed", "radio": "handset", "episodes": 3, "seed": 0}


def test_references_are_the_best_fixed_mode_the_paper_s_rule_and_the_imm():
    table = scores(
        random=[0, 0], fixed_ekf=[-3, -3], fixed_ukf=[-1, -2], speed_rule=[-2, -2], imm=[-1, -1]
    )
    assert references(table) == ["fixed-ukf", "speed-rule", "imm"]
    assert references(scores(random=[0.0], speed_rule_tuned=[1.0])) == []


def test_everyone_is_compared_with_every_reference():
    names = ("fixed-ekf", "fixed-ukf", "speed-rule", "random", "imm")
    table = scores(**{name.replace("-", "_"): np.arange(3.0) for name in names})
    table["fixed-ukf"]["reward"] += 100.0
    expected = [
        f"{name} - {reference}"
        for reference in ("fixed-ukf", "speed-rule", "imm")
        for name in names
        if name != reference
    ]
    assert list(compare(table, **WHAT).paired) == expected


def test_paired_differences_are_taken_episode_by_episode():
    rng = np.random.default_rng(0)
    hardness = rng.normal(0.0, 10.0, 40)  # shared, so that it cancels
    table = scores(speed_rule=hardness, random=hardness - 1.0 + 0.01 * rng.normal(size=40))
    result = compare(table, **WHAT)
    assert list(result.paired) == ["random - speed-rule"]
    difference = table["random"]["ate_m"] - table["speed-rule"]["ate_m"]
    (expected,) = bootstrap(difference[:, None])
    found = result.paired["random - speed-rule"]["ate_m"]
    assert found.mean == pytest.approx(difference.mean())
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))
    alone = result.policies["random"]["reward"]
    paired = result.paired["random - speed-rule"]["reward"]
    assert paired.high - paired.low < 0.01 * (alone.high - alone.low)


def test_results_as_json():
    result = compare(scores(speed_rule=[1.0, 2.0, 3.0], imm=[2.0, 2.0, 2.0]), **WHAT).json
    assert {key: result[key] for key in WHAT} == WHAT
    assert list(result) == [*WHAT, "policies", "paired"]
    assert result["policies"]["imm"]["reward"] == {"mean": 2.0, "ci95": [2.0, 2.0]}
    assert list(result["paired"]["imm - speed-rule"]) == list(METRICS)


# --- running


def assert_equal(found, expected):
    assert found.keys() == expected.keys()
    for name, rows in found.items():
        for metric in METRICS:
            np.testing.assert_array_equal(rows[metric], expected[name][metric])


def test_the_batch_scores_what_stepping_one_environment_scores():
    seeds = range(3)
    contender = contender_from("speed-rule", "handset")
    found = score(contender, contender.start(SOURCE.layout), draw_episodes(SOURCE, seeds))
    env = gym.make("MmWaveLoc-v0")
    policy = contender.policy(env.unwrapped.observation)
    for e, seed in enumerate(seeds):
        observation, _ = env.reset(seed=seed)
        rewards, truncated = [], False
        while not truncated:
            action = policy(observation[None])[0]
            observation, reward, _, truncated, info = env.step(action)
            rewards.append(reward)
        expected = {
            "reward": np.mean(rewards[10:]), "ate_m": info["ate_m"], "rmse_m": info["rmse_m"],
            "rpe_m": info["rpe_m"], "nees": info["mean_nees"], "in_bounds": info["in_bounds"],
            "divergence_rate": info["divergence"],
        }  # fmt: skip
        assert {m: v[e] for m, v in found.items()} == pytest.approx(expected, rel=1e-12)


def test_episodes_are_those_of_the_environment():
    env = gym.make("MmWaveLoc-v0")
    for episode, seed in zip(draw_episodes(SOURCE, [0, 5_000_000]), [0, 5_000_000], strict=True):
        _, info = env.reset(seed=seed)
        assert info["episode_name"] == episode.name
        np.testing.assert_array_equal(info["estimate"], episode.prior_mean)


def test_chunks_change_nothing(monkeypatch):
    whole = evaluate(["speed-rule"], SOURCE, "handset", episodes=5, seed=0)
    monkeypatch.setattr(evaluation, "CHUNK", 2)
    assert_equal(evaluate(["speed-rule"], SOURCE, "handset", episodes=5, seed=0), whole)


def test_seeds_run_from_the_first_one():
    both = evaluate(["fixed-ukf"], SOURCE, "handset", episodes=2, seed=7)["fixed-ukf"]
    second = evaluate(["fixed-ukf"], SOURCE, "handset", episodes=1, seed=8)["fixed-ukf"]
    assert all(len(both[m]) == 2 and both[m][1] == second[m][0] for m in METRICS)


def test_contenders_see_the_same_episodes():
    together = evaluate(["fixed-ekf", "fixed-ukf"], SOURCE, "handset", episodes=2, seed=0)
    alone = evaluate(["fixed-ukf"], SOURCE, "handset", episodes=2, seed=0)
    assert_equal({"fixed-ukf": together["fixed-ukf"]}, alone)
    assert (together["fixed-ekf"]["ate_m"] != together["fixed-ukf"]["ate_m"]).all()


@pytest.mark.parametrize("radio", RADIOS)
def test_every_radio_has_every_contender(radio):
    found = contenders(radio)
    assert list(found) == [
        "fixed-ekf", "fixed-ukf", "fixed-ckf", "fixed-ekf-robust", "fixed-ukf-robust",
        "speed-rule", "speed-rule-tuned", "likelihood-rule", "random", "imm", "imm-robust",
    ]  # fmt: skip
    assert all(c.name == name and c.modes for name, c in found.items())


def test_an_unknown_contender_lists_the_valid_ones():
    with pytest.raises(ValueError, match="policy: found 'oracle'.*fixed-ekf.*imm"):
        evaluate(["oracle"], SOURCE, "handset", episodes=1, seed=0)


@pytest.mark.parametrize("episodes", [0, -3])
def test_no_episodes_are_refused(episodes):
    with pytest.raises(ValueError, match="episodes"):
        evaluate(["fixed-ukf"], SOURCE, "handset", episodes=episodes, seed=0)


def test_episodes_without_truth_are_refused():
    (episode,) = draw_episodes(SOURCE, [0])
    blind = replace(episode, truth_position_m=None, truth_velocity_mps=None)
    contender = contender_from("fixed-ekf", "handset")
    with pytest.raises(ValueError, match="found no truth"):
        score(contender, contender.start(SOURCE.layout), [blind])


def test_a_name_twice_is_refused():
    with pytest.raises(ValueError, match="policies: found imm, imm, expected no name twice"):
        evaluate(["imm", "imm"], SOURCE, "handset", episodes=1, seed=0)


def test_actions_beyond_the_modes_are_refused():
    contender = contender_from("fixed-ekf", "handset")
    with pytest.raises(ValueError, match="found 5 to 5, expected 0 to 1"):
        score(contender, FixedMode(5), draw_episodes(SOURCE, [0]))


def test_own_modes_bring_their_own_contenders():
    modes = modes_from(["ekf", "ckf", "ukf-robust"])
    found = contenders("handset", modes)
    assert list(found) == [
        "fixed-ekf", "fixed-ckf", "fixed-ukf-robust", "likelihood-rule", "random", "imm",
    ]  # fmt: skip
    assert all(c.modes == modes for c in found.values())
    assert "speed-rule" in contenders("handset", modes[:2])
    own = evaluate(["fixed-ckf"], SOURCE, "handset", episodes=2, seed=0, modes=modes)
    named = evaluate(["fixed-ckf"], SOURCE, "handset", episodes=2, seed=0)
    for metric, values in own["fixed-ckf"].items():
        np.testing.assert_allclose(values, named["fixed-ckf"][metric], rtol=1e-9)


def test_a_ratio_of_means_has_an_interval():
    rng = np.random.default_rng(0)
    under = rng.uniform(1.0, 2.0, 400)
    ratio = bootstrap_ratio(0.5 * under + rng.normal(0.0, 0.01, 400), under)
    assert ratio.low < 0.5 < ratio.high and ratio.high - ratio.low < 0.01
    assert bootstrap_ratio(3.0 * under, under).low == pytest.approx(3.0)
