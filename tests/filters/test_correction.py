"""Tests that corrections of a belief equal products of matrices in numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import Frame, corrected, deviations_of

ANGLE = st.floats(-3.1, 3.1)
SHIFT = st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3)
LOG_FACTOR = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3)


def belief_of(seed=0, angle=0.5, speed=3.0, axes=(0, 1, 2)):
    """Return a belief with a random covariance; ``angle`` (rad) is the direction of motion."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(7, 7))
    x = rng.normal(size=7)
    x[3:5] = speed * np.cos(angle), speed * np.sin(angle)
    return Belief(x.tolist(), (root @ root.T + 0.1 * np.eye(7)).tolist(), axes)


@given(ANGLE, SHIFT, LOG_FACTOR, st.integers(0, 20))
def test_a_correction_is_a_shift_and_a_scaling_in_the_frame_of_motion(angle, shift, factors, seed):
    belief = belief_of(seed, angle)
    R = Rotation.from_euler("z", angle).as_matrix()  # columns: along the motion, across, up
    P = np.array(belief.P)
    deviations = np.sqrt(np.diag(R.T @ P[:3, :3] @ R))
    M = np.eye(7)
    M[:3, :3] = R @ np.diag(np.exp(factors)) @ R.T
    after = corrected(belief, shift, factors)
    assert_allclose(deviations_of(belief)[1], deviations, rtol=1e-9)
    moved = np.array(belief.x[:3]) + R @ (deviations * shift)
    assert_allclose(after.x, [*moved, *belief.x[3:]], atol=1e-9)
    assert_allclose(after.P, M @ P @ M.T, rtol=1e-7, atol=1e-9)
    assert np.linalg.eigvalsh(np.array(after.P))[0] > 0.0


def test_on_flat_terrain_the_height_is_not_corrected():
    belief = belief_of(axes=(0, 1))
    assert corrected(belief, [1.0, 1.0, 5.0], [0.0] * 3).x[2] == belief.x[2]


@given(ANGLE)
def test_the_frame_of_a_user_at_rest_has_the_axes_of_the_world(angle):
    frame = Frame.of([1e-6 * np.cos(angle), 1e-6 * np.sin(angle)])
    assert frame == pytest.approx((1.0, 0.0))
