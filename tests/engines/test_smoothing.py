"""Tests of the smoother, against filterpy on a linear model and against numpy on our tracks."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import Engine
from mmwave_env.engines.smoothing import smooth
from mmwave_env.filters import textbook
from tests.filters.tracks import packed, pipeline_of, simulated, unpacked

TOLERANCE = 1e-9
HZ_PER_MPS = 93.4
PARTS = ("x", "P", "x_predicted", "P_predicted")


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
    tracks = np.concatenate([*filtered, *predicted], axis=2)
    found_x, found_P = smooth(pipeline_of(), tracks, np.full((1, 60), dt), HZ_PER_MPS)
    assert_allclose(found_x[0], expected_x[..., 0], rtol=TOLERANCE, atol=TOLERANCE)
    assert_allclose(unpacked(found_P[0]), expected_P, rtol=TOLERANCE, atol=TOLERANCE)


def tracks(planar, n=9, epochs=120):
    """Return random times (n, epochs), and the PARTS of an EKF's tracks at these times."""
    time_s = np.random.default_rng(0).uniform(0.2, 2.0, (n, epochs)).cumsum(axis=1)
    episodes = [replace(e, time_s=t) for e, t in zip(simulated(n, epochs), time_s, strict=True)]
    tracker = Engine(pipeline_of(algorithms=["ekf"], planar=planar), n, observation="")
    tracker.load(episodes)
    return time_s, list(tracker.run(*PARTS).values())


def assert_smoothed_as_in_the_textbook(parts, time_s, tolerance, planar=False):
    """Smooth tracks at times (n, T), and compare them with the textbook's smoother, in numpy."""
    free = [0, 1, 3, 4, 6] if planar else list(range(7))
    dt = np.diff(time_s, prepend=0.0)
    pipeline = pipeline_of(planar=planar)
    smoothed = smooth(pipeline, np.concatenate(parts, axis=2), dt, HZ_PER_MPS)
    tracks = zip(*smoothed, *parts, time_s, strict=True)
    for smooth_x, smooth_P, x, P, _, P_predicted, times in tracks:
        filtered = x, unpacked(P), unpacked(P_predicted)
        expected_x, expected_P = textbook.rts(*filtered, times, free)
        assert_allclose(smooth_x, expected_x, rtol=tolerance, atol=tolerance)
        block = np.ix_(range(len(x)), free, free)
        assert_allclose(
            unpacked(smooth_P)[block], expected_P[block], rtol=10.0 * tolerance, atol=tolerance
        )


@pytest.mark.parametrize("planar", [False, True])
def test_smoothed_tracks_equal_a_plain_numpy_smoother(planar):
    time_s, parts = tracks(planar)
    assert_smoothed_as_in_the_textbook(parts, time_s, TOLERANCE, planar)


def test_smoothing_does_not_change_a_single_epoch():
    _, parts = tracks(planar=False)
    first = [part[:1, :1] for part in parts]
    smoothed = smooth(pipeline_of(), np.concatenate(first, axis=2), np.ones((1, 1)), HZ_PER_MPS)
    assert_array_equal(smoothed[0], first[0])
    assert_array_equal(smoothed[1], first[1])
