"""Tests of metrics, which must agree with the packages evo and scipy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2

from mmwave_env.engines.vector_step import Tally, count
from mmwave_env.metrics import BURN_IN, INFO_KEYS, METRICS, nees_interval, scored, summary

EPOCHS = 200
TOLERANCE = 1e-9
every_axes = pytest.mark.parametrize("axes", [2, 3])


def random_walk(seed, scale):
    return np.random.default_rng(seed).normal(0.0, scale, (EPOCHS, 3)).cumsum(axis=0)


@pytest.fixture(scope="module")
def tracks():
    """Return true and estimated positions (EPOCHS, 3), m."""
    truth = random_walk(0, 5.0) + [1000.0, -2000.0, 1.5]
    return truth, truth + random_walk(1, 0.3)


@pytest.fixture(scope="module")
def evo():
    """Return evo's module of metrics."""
    return pytest.importorskip("evo.core.metrics")


@pytest.fixture(scope="module")
def through_evo(tracks):
    """Return the tracks as trajectories of evo, with identity quaternions."""
    trajectory = pytest.importorskip("evo.core.trajectory").PosePath3D
    still = np.tile([1.0, 0.0, 0.0, 0.0], (EPOCHS, 1))
    return tuple(trajectory(position, still) for position in tracks)


def metrics_of(error, delta=1):
    """Return the metrics of all epochs of an error (..., T, 3); the burn-in is added before."""
    padded = np.concatenate([error[..., :BURN_IN, :], error], axis=-2)
    return summary(padded, padded[..., 0], delta)


def rpe(error, delta=1):
    """Return the RPE of all epochs of an error (..., T, 3)."""
    return metrics_of(error, delta)["rpe_m"]


def test_ate_and_rmse_equal_the_absolute_pose_error_of_evo(evo, tracks, through_evo):
    metric = evo.APE(evo.PoseRelation.translation_part)
    metric.process_data(through_evo)
    error = tracks[1] - tracks[0]
    mean = metric.get_statistic(evo.StatisticsType.mean)
    root = metric.get_statistic(evo.StatisticsType.rmse)
    assert metrics_of(error)["ate_m"] == pytest.approx(mean, abs=TOLERANCE)
    assert metrics_of(error)["rmse_m"] == pytest.approx(root, abs=TOLERANCE)


@pytest.mark.parametrize("delta", [1, 10])
def test_rpe_equals_the_relative_pose_error_of_evo(evo, tracks, through_evo, delta):
    metric = evo.RPE(evo.PoseRelation.translation_part, delta, evo.Unit.frames, all_pairs=delta > 1)
    metric.process_data(through_evo)
    assert len(metric.error) == EPOCHS - delta
    mean = metric.get_statistic(evo.StatisticsType.mean)
    assert rpe(tracks[1] - tracks[0], delta) == pytest.approx(mean, abs=TOLERANCE)


def test_metrics_accept_leading_axes(tracks):
    error = tracks[1] - tracks[0]
    batch = np.stack([error, 2.0 * error])
    for name in ("ate_m", "rmse_m", "rpe_m"):
        alone = metrics_of(error)[name]
        assert_allclose(metrics_of(batch)[name], [alone, 2.0 * alone])


def test_the_rpe_is_zero_if_the_track_is_not_longer_than_the_interval():
    assert_array_equal(rpe(np.ones((2, 10, 3)), 10), [0.0, 0.0])


def test_default_nees_interval_is_95_percent_of_three_axes():
    assert_allclose(nees_interval(), chi2.ppf([0.025, 0.975], 3), rtol=1e-12)
    assert_allclose(nees_interval(2), chi2.ppf([0.025, 0.975], 2), rtol=1e-12)


@pytest.mark.parametrize(("epochs", "counted"), [(200, 190), (11, 1), (10, 1), (1, 1)])
def test_the_first_ten_epochs_do_not_count_but_the_last_epoch_always_does(epochs, counted):
    assert len(np.arange(epochs)[scored(epochs)]) == counted


def columns(episodes=3):
    """Return random rewards, errors and NEES of a few episodes."""
    rng = np.random.default_rng(0)
    return (
        rng.normal(size=(episodes, EPOCHS)),
        rng.normal(size=(episodes, EPOCHS, 3)),
        rng.chisquare(3, (episodes, EPOCHS)),
    )


@every_axes
def test_the_summary_averages_over_all_but_the_first_ten_epochs(axes):
    reward, error, nees = columns()
    metrics = summary(error, nees, axes=axes, reward=reward)
    assert set(metrics) == set(METRICS)
    assert_allclose(metrics["reward"], reward[:, 10:].mean(axis=1))
    counted = nees[:, 10:]
    length = np.linalg.norm(error[:, 10:], axis=-1)
    assert_allclose(metrics["ate_m"], length.mean(axis=1))
    assert_allclose(metrics["rmse_m"], np.sqrt((length**2).mean(axis=1)))
    assert_allclose(metrics["rpe_m"], rpe(error[:, 10:]))
    assert_allclose(metrics["nees"], counted.mean(axis=1))
    low, high = chi2.ppf([0.025, 0.975], axes)
    inside = (counted > low) & (counted < high)
    assert_allclose(metrics["in_bounds"], inside.mean(axis=1))


@pytest.mark.parametrize(("rate", "delta"), [(0.5, 1), (1.0, 1), (2.0, 2), (10.0, 10)])
def test_the_rpe_of_the_summary_spans_one_second(rate, delta):
    _, error, nees = columns()
    metrics = summary(error, nees, epochs_per_s=rate)["rpe_m"]
    assert_allclose(metrics, rpe(error[:, 10:], delta))


@pytest.mark.parametrize(("error_m", "diverged"), [(49.9, 0.0), (50.1, 1.0), (np.nan, 1.0)])
def test_an_error_above_50_m_or_nan_at_any_epoch_counts_as_divergence(error_m, diverged):
    _, error, nees = columns(episodes=1)
    error[0, 100] = [error_m, 0.0, 0.0]
    assert summary(error, nees)["divergence_rate"] == [diverged]


@pytest.mark.parametrize("lost", [False, True])
@every_axes
@pytest.mark.parametrize("dt", [1e-9, 0.1, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("epochs", [1, 5, 10, 11, 12, 25, 200])
def test_an_episode_ends_with_the_metrics_of_its_track(epochs, dt, axes, lost):
    """Check also an episode that has diverged because an error in its middle is NaN."""
    rng = np.random.default_rng(epochs)
    tally = Tally(3, axes)
    where = np.array([1])
    for _ in range(2):  # the first episode does not affect the second
        tally.begin(where, np.array([dt]), np.array([epochs]))
        errors = rng.normal(0.0, 20.0, (epochs, 3))
        nees = rng.chisquare(axes, epochs)
        if lost:
            errors[epochs // 2] = np.nan
        for k, (error, number) in enumerate(zip(errors, nees, strict=True)):
            count(tally.counts, 1, k, *error, number)
        metrics = tally.metrics(where, np.array([epochs]))
    expected = summary(errors, nees, max(1.0, round(1.0 / dt)), axes)
    assert {key: value.item() for key, value in metrics.items()} == pytest.approx(
        {key: float(expected[key]) for key in INFO_KEYS}, rel=1e-12, nan_ok=True
    )
    assert not tally.counts.sums[[0, 2]].any()
    assert tally.counts.errors.shape[1] <= epochs  # no longer than the episode, if < 1 s
