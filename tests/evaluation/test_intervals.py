"""Tests of bootstrap intervals, against scipy, plain resampling and formulas."""

import numpy as np
import pytest
from scipy.stats import bootstrap as scipy_bootstrap
from scipy.stats import norm, t

from experiments.evaluation.intervals import (
    RESAMPLES,
    bootstrap,
    bootstrap_ratio,
    crossed_bootstrap,
    few_seeds_factor,
    rounded,
)

# Two independent 2.5 % quantiles of resampled means differ by more than this number of standard
# deviations of these means, or 4.5 standard errors of the difference, in one of 10^5 tests.
MARGIN = 4.5 * np.sqrt(2.0 * 0.025 * 0.975 / RESAMPLES) / norm.pdf(norm.ppf(0.025))

# --- over episodes


def test_one_episode_gives_a_mean_and_no_interval():
    (interval,) = bootstrap([[1.25]])
    assert interval.json == {"mean": 1.25, "ci95": None}
    assert str(interval) == "1.250" == rounded(interval)


@pytest.mark.parametrize("n", [5, 60])
def test_intervals_agree_with_scipy_s_bootstrap(n):
    values = np.random.default_rng(0).exponential(2.0, (2, n))
    ours = bootstrap(values)
    for row, interval in zip(values, ours, strict=True):
        same = {"n_resamples": RESAMPLES, "method": "percentile", "rng": np.random.default_rng(0)}
        other = scipy_bootstrap((row,), np.mean, **same).confidence_interval
        margin = MARGIN * row.std() / np.sqrt(n)
        assert interval.mean == pytest.approx(row.mean())
        assert abs(interval.low - other.low) <= margin
        assert abs(interval.high - other.high) <= margin


def test_a_ratio_of_means_has_an_interval():
    rng = np.random.default_rng(0)
    under = rng.uniform(1.0, 2.0, (1, 400))
    (ratio,) = bootstrap_ratio(0.5 * under + rng.normal(0.0, 0.01, (1, 400)), under)
    assert ratio.low < 0.5 < ratio.high and ratio.high - ratio.low < 0.01
    assert bootstrap_ratio(3.0 * under, under)[0].low == pytest.approx(3.0)


def test_each_row_has_a_ratio_which_is_nan_if_the_denominator_is_zero():
    over = np.random.default_rng(0).uniform(1.0, 2.0, (3, 50))
    equal, nothing, half = bootstrap_ratio(over, [over[0], np.zeros(50), 2.0 * over[2]])
    assert (equal.mean, half.mean) == pytest.approx((1.0, 0.5))
    assert np.isnan(nothing).all()
    (once,) = bootstrap_ratio(over[:1], np.eye(50)[:1])
    # Some resamples have only zeros in the denominator, so the interval is unknown.
    assert once.mean == pytest.approx(over[0].sum()) and not once.known


# --- over training seeds


def plain_deviations(scores, rng, resamples):
    """Widen the spread over seeds, resample in a loop, and return means minus the mean score."""
    K, n = scores.shape
    apart = scores.mean(axis=1) - scores.mean()
    moved = scores + ((few_seeds_factor(K) - 1.0) * apart)[:, None]

    means = [
        moved[rng.integers(K, size=K)][:, rng.integers(n, size=n)].mean() for _ in range(resamples)
    ]
    return np.array(means) - moved.mean()


def test_seeds_and_episodes_are_resampled_independently():
    rng = np.random.default_rng(0)
    scores = rng.normal(0.3, 0.5, (4, 1)) + rng.normal(size=30) + rng.normal(size=(4, 30))
    interval = crossed_bootstrap(scores)
    deviations = plain_deviations(scores, rng, RESAMPLES)
    assert interval.mean == pytest.approx(scores.mean())
    for end, quantile in ((interval.low, 2.5), (interval.high, 97.5)):
        other = scores.mean() + np.percentile(deviations, quantile)
        assert abs(end - other) < MARGIN * deviations.std()


@pytest.mark.parametrize("seeds", [1, 5])
def test_one_seed_or_seeds_with_equal_scores_have_the_interval_over_episodes(seeds):
    episodes = np.random.default_rng(0).exponential(size=50)
    (expected,) = bootstrap([episodes])
    assert crossed_bootstrap(np.tile(episodes, (seeds, 1))) == pytest.approx(expected)


@pytest.mark.parametrize("K", [5, 30])
def test_if_only_seeds_differ_the_interval_follows_student_s_t(K):
    seeds = np.random.default_rng(1).normal(size=K)
    interval = crossed_bootstrap(np.tile(seeds[:, None], (1, 10)))
    half = t.ppf(0.975, K - 1) * seeds.std(ddof=1) / np.sqrt(K)
    # With few seeds, resampled means are as skewed as the seeds, so only the width is compared.
    assert interval.mean == pytest.approx(seeds.mean())
    assert interval.high - interval.low == pytest.approx(2.0 * half, rel=0.06)


def test_few_seeds_have_wider_intervals():
    assert few_seeds_factor(5) == pytest.approx(np.sqrt(5 / 4) * 2.776445 / 1.959964, rel=1e-6)
    assert few_seeds_factor(1) == 1.0 < few_seeds_factor(1000) < 1.002
