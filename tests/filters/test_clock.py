"""Tests of filters that also estimate the range bias, against textbook filters with 8 states."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from mmwave_env.filters import textbook
from mmwave_env.filters.gating import Gate
from mmwave_env.filters.linearization import SigmaPoints
from mmwave_env.filters.update import ckf, ekf, ukf, update
from tests.filters import gated_textbook
from tests.filters.problems import assert_same, assume_clear_of, problems

OURS = {"ekf": ekf, "ukf": ukf, "ckf": ckf}
GATES = [Gate(None), Gate(0.99), Gate(0.5, force=1.0), Gate(0.99, robust=True)]
# Order of the states when our filters factor P. With odometry, which is nonlinear in the velocity,
# results of sigma points depend on the factor, so the textbook's state gets the same order.
ORDER = [0, 1, 2, 7, 3, 4, 5, 6]
algorithms = pytest.mark.parametrize("algorithm", OURS)
with_odometry = pytest.mark.parametrize("odometry", [False, True], ids=["radio", "odometry"])


@algorithms
@with_odometry
@pytest.mark.parametrize("partial", [False, True], ids=["whole", "partial"])
@pytest.mark.parametrize("gate", GATES, ids=str)
@given(data=st.data())
@settings(max_examples=10, deadline=None)
def test_update_equals_textbook(algorithm, odometry, partial, gate, data):
    problem = data.draw(problems(odometry, partial=partial, clock=True))
    expected = in_order(problem, textbook.METHODS[algorithm], gate)
    if gate.quantile is not None:
        assume_clear_of(expected.nis, problem.seen, [lambda n: chi2.ppf(gate.quantile, n)])
    visible = problem.visible if partial else None
    assert_same(problem.ours(OURS[algorithm], gate), expected, visible=visible)


def in_order(problem, moments, gate):
    """Return the textbook's update, computed with the state in the order ORDER."""
    groups, links, x, P, *measured = problem.update
    model = gated_textbook.Restricted(problem.seen, x, ORDER)
    prior, rule = (x[ORDER], P[np.ix_(ORDER, ORDER)]), (gate.quantile, gate.force, gate.robust)
    update = gated_textbook.update(moments, model, groups, links, *prior, *measured, *rule)
    back = np.argsort(ORDER)
    return update._replace(x=update.x[back], P=update.P[np.ix_(back, back)])


@with_odometry
@given(data=st.data())
@settings(max_examples=10, deadline=None)
def test_scaled_sigma_points_equal_textbook(odometry, data):
    problem = data.draw(problems(odometry, clock=True))

    def ours(x, P, measurement, gate):
        return update(x, P, measurement, gate, SigmaPoints(0.5, 2.0, 0.5))

    expected = in_order(problem, textbook.unscented(0.5, 2.0, 0.5), Gate(None))
    assert_same(problem.ours(ours, Gate(None)), expected)


@pytest.mark.parametrize(
    ("algorithm", "moments"),
    [
        ("ekf", textbook.tangent),
        ("ukf", textbook.unscented(1.0, 2.0, 2.0)),
        ("ckf", textbook.unscented(1.0, 0.0, 2.0)),
    ],
)
@given(data=st.data())
@settings(max_examples=10, deadline=None)
def test_planar_update_equals_that_of_the_six_free_states(algorithm, moments, data):
    problem, free, known = data.draw(problems(clock=True)), [0, 1, 3, 4, 6, 7], [2, 5]
    P = problem.P.copy()
    P[known, :] = P[:, known] = 0.0
    restricted = gated_textbook.Restricted(problem.sensor, problem.x, free)
    groups, links, _, _, *measured = problem.update
    prior = problem.x[free], P[np.ix_(free, free)]
    expected = gated_textbook.update(moments, restricted, groups, links, *prior, *measured)
    ours = problem.ours(OURS[algorithm], Gate(None), P)
    whole = np.array(ours.P)
    part = ours._replace(x=np.array(ours.x)[free], P=whole[np.ix_(free, free)])
    assert_same(part, expected)
    assert not whole[known].any()


@given(problem=problems(odometry=True, clock=True))
@settings(max_examples=20, deadline=None)
def test_textbook_jacobian_is_the_derivative(problem):
    s, x = problem.sensor, problem.x
    columns = [s.difference(s.h(x + e), s.h(x - e)) / 2e-4 for e in 1e-4 * np.eye(8)]
    np.testing.assert_allclose(s.jacobian(x), np.array(columns).T, rtol=1e-5, atol=1e-5)
