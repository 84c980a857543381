"""Tests of interpolating a true track."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from mmwave_env.logs.truth import BRIDGED_S, TOLERANCE_S, Truth
from mmwave_env.logs.tum import tum_lines


def truth_of(folder, time_s, position_m):
    path = folder / "truth.tum"
    path.write_text(tum_lines(time_s, position_m))
    return Truth(path)


def expected(pose_s, position, time_s):
    """Return positions from SciPy's cubic splines; NaN in gaps."""
    p = np.full((len(time_s), 3), np.nan)
    runs = np.split(np.arange(len(pose_s)), np.flatnonzero(np.diff(pose_s) > BRIDGED_S) + 1)
    for run in runs:
        t = pose_s[run]
        x = position[run]
        away = np.abs(time_s[:, None] - t)
        near = away.min(axis=1) <= TOLERANCE_S
        p[near] = x[away[near].argmin(axis=1)]
        if len(run) > 1:
            curve = CubicHermiteSpline(t, x, np.gradient(x, t, axis=0))
            inside = (time_s >= t[0]) & (time_s <= t[-1])
            p[inside] = curve(time_s[inside])
    return p


times = st.lists(st.integers(0, 4000), min_size=1, max_size=60, unique=True)


@settings(max_examples=80)
@given(poses=times, epochs=times, late=st.sampled_from([0.0, 1e-3]))
def test_poses_are_interpolated_but_not_across_gaps(tmp_path_factory, poses, epochs, late):
    pose_s = np.sort(poses) * 1e-2
    time_s = np.sort(epochs) * 1e-2 + late
    position = np.random.default_rng(0).standard_normal((len(pose_s), 3))
    truth = truth_of(tmp_path_factory.mktemp("truth"), pose_s, position)
    np.testing.assert_allclose(truth.at(time_s), expected(pose_s, position, time_s), atol=1e-9)
    assert (truth.first_s, truth.last_s) == (pose_s[0], pose_s[-1])
