"""Tests that our filters, filterpy and the textbook agree right below, above and at an anchor."""

import numpy as np
import pytest

from mmwave_env.filters import Gate, textbook
from mmwave_env.filters.modes import ALGORITHMS
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import NEAREST_M, exact_rows
from tests.filters.gated_textbook import groups_of
from tests.filters.problems import HZ_PER_MPS, Problem, assert_same, derivative

ANCHORS = np.array([[0.0, 0.0, 10.0], [80.0, 60.0, 12.0], [-50.0, 70.0, 15.0]])
SILENT = {"vertical": [1, 3], "anchor": [1, 2, 3, 12]}  # position -> rows without information
# name -> (prior mean minus first anchor in m, key of SILENT; None if all rows have information)
OFFSETS = {
    "below": ((0.0, 0.0, -8.5), "vertical"),
    "above": ((0.0, 0.0, 20.0), "vertical"),
    "too close to the vertical": ((0.6 * NEAREST_M, -0.6 * NEAREST_M, -8.5), "vertical"),
    "at the anchor": ((0.0, 0.0, 0.0), "anchor"),
    "too close to the anchor": ((0.3 * NEAREST_M, -0.4 * NEAREST_M, 0.5 * NEAREST_M), "anchor"),
    "far enough from the vertical": ((1.2 * NEAREST_M, 0.7 * NEAREST_M, -8.5), None),
    "far enough from the anchor": ((-1.1 * NEAREST_M, 1.2 * NEAREST_M, 0.9 * NEAREST_M), None),
}
algorithms = pytest.mark.parametrize("algorithm", ALGORITHMS)
everywhere = pytest.mark.parametrize("where", OFFSETS)


def near(where, odometry=False):
    """Return a Problem whose prior mean is at the offset ``where``, about 2 m from the truth."""
    sensor = textbook.Sensor(ANCHORS, HZ_PER_MPS, odometry)
    x = np.array([*(ANCHORS[0] + OFFSETS[where][0]), 3.0, -2.0, 0.1, 20.0])
    scale = np.array([3.0, 3.0, 1.0, 1.0, 1.0, 0.3, 50.0])
    factor = scale[:, None] * (np.eye(7) + np.tril(np.full((7, 7), 0.2), -1))
    sigma = np.array([0.5, 0.05, 0.05, 0.05] * 3 + [50.0] + [0.5, 0.1] * odometry)
    z = sensor.h(x + factor @ [0.5, -0.3, 0.4, 0.2, 0.1, -0.2, 0.3])
    visible = np.ones(len(groups_of(sensor)), bool)
    return Problem(x, factor @ factor.T, sensor, z, sigma**2, visible)


@algorithms
@everywhere
@pytest.mark.parametrize("odometry", [False, True], ids=["radio", "odometry"])
@pytest.mark.parametrize("gate", [Gate(None), Gate(0.99), Gate(0.99, robust=True)], ids=str)
def test_an_update_near_an_anchor_equals_the_textbook(algorithm, where, odometry, gate):
    problem = near(where, odometry)
    assert_same(
        problem.ours(ALGORITHMS[algorithm], gate),
        problem.textbook(textbook.METHODS[algorithm], gate),
        rtol=1e-6,  # next to an anchor, angles change by a thousand radians per meter
    )


@everywhere
def test_jacobian_rows_of_undefined_angles_are_zero_and_other_rows_are_derivatives(where):
    problem = near(where)
    _, lost = OFFSETS[where]
    s = problem.sensor
    x = problem.x
    silent = SILENT.get(lost, [])
    assert np.flatnonzero(s.silent(x)).tolist() == silent
    H = s.jacobian(x)
    assert np.isfinite(H).all() and not H[silent].any()
    if lost is None:
        np.testing.assert_allclose(H, derivative(s, x, 1e-7), rtol=1e-4, atol=1e-3)


def test_the_exact_measurement_of_a_user_at_an_anchor_is_finite():
    rows = exact_rows([1.0, 2.0, 3.0], [3.0, 0.0, 0.0], [[1.0, 2.0, 3.0]], 93.4, Layout(1))
    assert rows == [0.0, 0.0, 0.0, np.pi, 0.0]
