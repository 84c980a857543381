"""Tests of the smoother, against filterpy on a linear model and against numpy on our tracks."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import run_imm, tracks_of
from mmwave_env.engines.smoothing import smooth
from mmwave_env.filters import textbook
from mmwave_env.filters.bank import best_bank
from mmwave_env.interface.reward import TrackingReward
from tests.filters.tracks import TRIANGLE, pipeline_of, sampled, simulated, street_source, unpacked

TOLERANCE = 1e-9
PARTS = ("x", "P", "x_predicted", "P_predicted")


def packed(P):
    return P[..., TRIANGLE[0], TRIANGLE[1]]


@pytest.mark.parametrize("dt", [0.1, 1.0, 3.0])
def test_smoothing_a_linear_model_equals_filterpy(dt):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 7))
    kf = KalmanFilter(7, 4)
    kf.F = textbook.F(dt)
    kf.Q = dt * (0.1 * root @ root.T + 0.05 * np.eye(7))
    kf.H = rng.normal(size=(4, 7))
    kf.R = np.diag([0.5, 1.0, 2.0, 4.0])
    kf.x = rng.normal(size=(7, 1))
    kf.P = 10.0 * np.eye(7)
    x, P, x_predicted, P_predicted = kf.batch_filter(rng.normal(0.0, 5.0, (60, 4, 1)))
    expected_x, expected_P, *_ = kf.rts_smoother(x, P)
    filtered = x[None, ..., 0], packed(P)[None]
    predicted = x_predicted[None, ..., 0], packed(P_predicted)[None]
    found_x, found_P = smooth(*filtered, *predicted, np.full(59, dt))
    assert_allclose(found_x[0], expected_x[..., 0], rtol=TOLERANCE, atol=TOLERANCE)
    assert_allclose(unpacked(found_P[0]), expected_P, rtol=TOLERANCE, atol=TOLERANCE)


def tracks(planar, n=9, epochs=120):
    """Return random times (n, epochs), and the PARTS of an EKF's tracks at these times."""
    time_s = np.random.default_rng(0).uniform(0.2, 2.0, (n, epochs)).cumsum(axis=1)
    episodes = [replace(e, time_s=t) for e, t in zip(simulated(n, epochs), time_s, strict=True)]
    tracker = tracks_of(pipeline_of(algorithms=["ekf"], planar=planar), n)
    tracker.load(episodes)
    return time_s, list(tracker.run(*PARTS).values())


@pytest.mark.parametrize("planar", [False, True])
def test_smoothed_tracks_equal_a_plain_numpy_smoother(planar):
    time_s, (x, P, x_predicted, P_predicted) = tracks(planar)
    free = [0, 1, 3, 4, 6] if planar else list(range(7))
    found_x, found_P = smooth(x, P, x_predicted, P_predicted, np.diff(time_s), planar)
    for e in range(len(x)):
        expected_x, expected_P = textbook.rts(
            x[e], unpacked(P[e]), unpacked(P_predicted[e]), time_s[e], free
        )
        assert_allclose(found_x[e], expected_x, rtol=TOLERANCE, atol=TOLERANCE)
        block = np.ix_(range(len(x[e])), free, free)
        assert_allclose(unpacked(found_P[e])[block], expected_P[block], rtol=1e-8, atol=TOLERANCE)


@pytest.mark.parametrize("dt", [1.0, 0.1])
def test_smoothing_a_mixture_equals_plain_numpy(dt):
    source = street_source(dt=dt)
    episodes = [sampled(source, seed) for seed in range(9)]
    x, P, x_predicted, P_predicted = run_imm(
        best_bank(), TrackingReward(), episodes, *PARTS
    ).values()
    time_s = dt * np.arange(x.shape[1])
    found_x, found_P = smooth(x, P, x_predicted, P_predicted, np.diff(time_s))
    for e in range(len(x)):
        track = x[e], unpacked(P[e]), unpacked(P_predicted[e]), time_s
        expected = textbook.rts(*track, x_predicted=x_predicted[e])
        assert_allclose(found_x[e], expected[0], rtol=1e-7, atol=1e-7)
        assert_allclose(unpacked(found_P[e]), expected[1], rtol=1e-6, atol=1e-6)


def test_smoothing_does_not_change_a_single_epoch():
    _, parts = tracks(planar=False)
    x, P, x_predicted, P_predicted = (part[:1, :1] for part in parts)
    smoothed_x, smoothed_P = smooth(x, P, x_predicted, P_predicted, np.empty(0))
    assert_array_equal(smoothed_x, x)
    assert_array_equal(smoothed_P, P)
