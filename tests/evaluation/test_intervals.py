"""Tests of bootstrap intervals, against scipy, plain resampling, formulas and simulations."""

from dataclasses import astuple

import numpy as np
import pytest
from scipy.stats import bootstrap as scipy_bootstrap
from scipy.stats import norm, t

from experiments.evaluation import intervals
from experiments.evaluation.intervals import (
    RESAMPLES,
    Interval,
    bootstrap,
    bootstrap_ratio,
    crossed_bootstrap,
    few_seeds_factor,
    rounded,
)
from tests.paths import representative

# --- over episodes


def test_one_episode_gives_a_mean_and_no_interval():
    (interval,) = bootstrap(np.array([[1.25]]))
    assert interval.json == {"mean": 1.25, "ci95": None}
    assert str(interval) == "1.250" == rounded(interval)


@pytest.mark.parametrize("n", [5, 60])
def test_intervals_agree_with_scipy_s_bootstrap(n):
    values = np.random.default_rng(0).exponential(2.0, (n, 2))
    ours = bootstrap(values)
    # A 2.5 % quantile of resampled means has a standard error of quantile_error times the standard
    # deviation of these means. Two independent quantiles differ by more than 4.5 sqrt(2) standard
    # errors in only one of 10^5 tests.
    quantile_error = np.sqrt(0.025 * 0.975 / RESAMPLES) / norm.pdf(norm.ppf(0.025))
    for column, interval in zip(values.T, ours, strict=True):
        same = {"n_resamples": RESAMPLES, "method": "percentile", "rng": np.random.default_rng(0)}
        other = scipy_bootstrap((column,), np.mean, **same).confidence_interval
        margin = 4.5 * np.sqrt(2.0) * quantile_error * column.std() / np.sqrt(n)
        assert interval.mean == pytest.approx(column.mean())
        assert abs(interval.low - other.low) <= margin
        assert abs(interval.high - other.high) <= margin


def test_a_ratio_of_means_has_an_interval():
    rng = np.random.default_rng(0)
    under = rng.uniform(1.0, 2.0, (400, 1))
    (ratio,) = bootstrap_ratio(0.5 * under + rng.normal(0.0, 0.01, (400, 1)), under)
    assert ratio.low < 0.5 < ratio.high and ratio.high - ratio.low < 0.01
    assert bootstrap_ratio(3.0 * under, under)[0].low == pytest.approx(3.0)


def test_each_column_has_a_ratio_which_is_nan_if_the_denominator_is_zero():
    over = np.random.default_rng(0).uniform(1.0, 2.0, (50, 3))
    under = np.stack([over[:, 0], np.zeros(50), 2.0 * over[:, 2]], axis=1)
    equal, nothing, half = bootstrap_ratio(over, under)
    assert (equal.mean, half.mean) == pytest.approx((1.0, 0.5))
    assert np.isnan([nothing.mean, nothing.low, nothing.high]).all()
    (once,) = bootstrap_ratio(over[:, :1], np.eye(50)[:, :1])
    # Some resamples have only zeros in the denominator, so the interval is unknown.
    assert once.mean == pytest.approx(over[:, 0].sum()) and not once.known


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
    margin = 4.5 * np.sqrt(2.0 * 0.025 * 0.975 / RESAMPLES) / norm.pdf(norm.ppf(0.025))
    for end, quantile in ((interval.low, 2.5), (interval.high, 97.5)):
        other = scores.mean() + np.percentile(deviations, quantile)
        assert abs(end - other) < margin * deviations.std()


def alike(interval):
    """Return an interval that equals the given interval up to rounding."""
    return Interval(*(pytest.approx(part) for part in astuple(interval)))


@pytest.mark.parametrize("seeds", [1, 5])
def test_one_seed_or_seeds_with_equal_scores_have_the_interval_over_episodes(seeds):
    episodes = np.random.default_rng(0).exponential(size=50)
    assert crossed_bootstrap(np.tile(episodes, (seeds, 1))) == alike(*bootstrap(episodes[:, None]))


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


# A score is the sum of three random numbers: one drawn for the training seed, one for the episode,
# and one for the pair of both. These are the standard deviations of the three numbers.
SPREADS = {"seeds": (1.0, 0.0, 0.1), "episodes": (0.0, 1.0, 0.1), "all": (0.2, 0.7, 0.7)}


@pytest.fixture
def fewer_resamples(monkeypatch):
    """Use 500 instead of 4000 resamples to save time; 500 are enough to measure coverage."""
    intervals._resamples.cache_clear()
    monkeypatch.setattr(intervals, "RESAMPLES", 500)
    yield
    intervals._resamples.cache_clear()


def coverage(K, spread, trials=400, episodes=40):
    """Return the share of intervals that contain the true mean, zero."""
    rng = np.random.default_rng(K)
    held = 0
    of_seeds, of_episodes, of_both = spread
    for _ in range(trials):
        scores = of_seeds * rng.normal(size=(K, 1)) + of_episodes * rng.normal(size=episodes)
        scores = scores + of_both * rng.normal(size=(K, episodes))
        interval = crossed_bootstrap(scores)
        held += interval.low <= 0.0 <= interval.high
    return held / trials


@pytest.mark.slow
@pytest.mark.parametrize("spread", SPREADS)
@pytest.mark.parametrize("K", representative([3, 5, 10], 5))
@pytest.mark.usefixtures("fewer_resamples")
def test_intervals_contain_the_truth_in_about_95_percent_of_trials(K, spread):
    share = coverage(K, SPREADS[spread])
    # Over 400 trials, three standard errors of the share are 0.033. Small samples lower the share a
    # little. The interaction of seeds and episodes counts twice (Owen 2007) and raises the share.
    assert 0.91 < share < 0.99
