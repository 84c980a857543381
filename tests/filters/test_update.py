"""Tests that our updates equal textbook updates, although ours first fuse a link's azimuths."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mmwave_env.filters import Gate, SigmaPoints, textbook, update
from mmwave_env.filters.modes import ALGORITHMS
from tests.filters.problems import (
    GATES,
    HZ_PER_MPS,
    Problem,
    assert_same,
    assume_clear_of,
    derivative,
    problems,
)

KINDS = {
    "radio": {},
    "nine anchors": {"anchors": 9},  # so many groups that log(determinant) is computed in two parts
    "odometry": {"odometry": True},
    "some rows": {"partial": True},
    "odometry and some rows": {"odometry": True, "partial": True},
    "clock": {"clock": True},
    "clock, odometry and some rows": {"clock": True, "odometry": True, "partial": True},
}

algorithms = pytest.mark.parametrize("algorithm", ALGORITHMS)
whole_kinds = pytest.mark.parametrize("kind", ["radio", "odometry", "clock"])
any_data = given(data=st.data())


@algorithms
@pytest.mark.parametrize("kind", KINDS)
@any_data
@settings(max_examples=25)
def test_an_update_equals_the_textbook(algorithm, kind, data):
    """Check also problems with missing rows, in which any anchor may have the Doppler shift."""
    problem = data.draw(problems(**KINDS[kind]))
    gate = data.draw(st.sampled_from(GATES))
    expected = problem.textbook(textbook.METHODS[algorithm], gate)
    assume_clear_of(expected.nis, problem.seen, gate.quantile)
    visible = problem.visible if "some rows" in kind else None
    assert_same(problem.ours(ALGORITHMS[algorithm], gate), expected, visible=visible)


@whole_kinds
@pytest.mark.parametrize(
    "parameters", [(0.5, 2.0, 0.0), (1.0, 2.0, -4.0), (1.0, 2.0, 3.0)], ids=str
)
@any_data
@settings(max_examples=15)
def test_an_update_with_any_scaled_sigma_points_equals_the_textbook(kind, parameters, data):
    problem = data.draw(problems(**KINDS[kind]))

    def ours(x, P, measurement, gate):
        return update(x, P, measurement, gate, SigmaPoints(*parameters))

    expected = problem.textbook(textbook.unscented(*parameters), Gate(None))
    assume(np.all(np.linalg.eigvalsh(expected.P) > 0.0))
    assert_same(problem.ours(ours, Gate(None)), expected)


@pytest.mark.parametrize(
    ("algorithm", "moments"),
    [
        # 5 states with kappa = 2 have sigma points as far out as 7 states with kappa = 0.
        ("ekf", textbook.tangent),
        ("ukf", textbook.unscented(1.0, 2.0, 2.0)),
        ("ckf", textbook.unscented(1.0, 0.0, 2.0)),
    ],
)
@whole_kinds
@any_data
@settings(max_examples=12)
def test_a_planar_update_equals_that_of_the_five_free_states(algorithm, moments, kind, data):
    """Compare with six free states if the state includes a clock's range bias."""
    problem = data.draw(problems(**KINDS[kind]))
    gate = Gate(0.99)
    known_axes = [2, 5]
    free = [i for i in problem.order if i not in known_axes]
    expected = problem.textbook(moments, gate, free=free)
    assume_clear_of(expected.nis, problem.sensor, gate.quantile)
    P = problem.P.copy()
    P[known_axes, :] = P[:, known_axes] = 0.0
    ours = problem.ours(ALGORITHMS[algorithm], gate, P)
    free = sorted(free)
    whole = np.array(ours.P)
    reduced = whole[np.ix_(free, free)]
    assert_same(ours._replace(x=np.array(ours.x)[free], P=reduced), expected)
    assert [ours.x[i] for i in known_axes] == problem.x[known_axes].tolist()
    assert not whole[known_axes].any()
    assert not whole[:, known_axes].any()


def link_to_the_east(azimuth_of_arrival, azimuth_of_departure):
    """Return a problem with an anchor 100 m east of the user; exact azimuths would be pi and 0."""
    sensor = textbook.Sensor(np.array([[100.0, 0.0, 10.0]]), HZ_PER_MPS)
    x = np.array([0.0, 0.0, 1.5, 3.0, -2.0, 0.1, 20.0])
    P = np.diag([4.0, 2.0, 0.5, 1.0, 1.0, 0.1, 900.0])
    z = sensor.h(x)
    z[[1, 3]] = azimuth_of_arrival, azimuth_of_departure
    R = np.array([0.25, 4e-4, 1e-4, 9e-4, 400.0])
    return Problem(x, P, sensor, z, R, np.ones(2, bool))


@algorithms
@pytest.mark.parametrize("arrival", [3.1, -3.1, np.pi, -np.pi])
@pytest.mark.parametrize("departure", [0.05, -0.05, 0.0])
def test_fused_azimuths_have_the_nis_of_all_rows_at_180_degrees_too(algorithm, arrival, departure):
    problem = link_to_the_east(arrival, departure)
    ours = problem.ours(ALGORITHMS[algorithm], Gate(None))
    assert ours.nis[0] < 20.0  # residuals are wrapped
    assert_same(ours, problem.textbook(textbook.METHODS[algorithm], Gate(None)))


@given(problem=problems(odometry=True, clock=True))
@settings(max_examples=30)
def test_the_textbook_jacobian_equals_the_numerical_derivative(problem):
    s = problem.sensor
    x = problem.x
    np.testing.assert_allclose(s.jacobian(x), derivative(s, x, 1e-4), rtol=1e-5, atol=1e-5)
