"""The update against the textbook's: all rows at once, nothing fused, nothing reduced."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.stats import chi2

from mmwave_env.estimator.linearise import SigmaPoints
from mmwave_env.estimator.update import Gate, ckf, ekf, ukf, update
from mmwave_env.measurement import Layout, Measurement

from . import textbook

OURS = {"ekf": ekf, "ukf": ukf, "ckf": ckf}
GATES = {"no gate": Gate(None), "99 %": Gate(0.99), "median": Gate(0.5)}
HZ_PER_MPS = 93.4
RTOL = 1e-9

algorithms = pytest.mark.parametrize("algorithm", OURS)
with_odometry = pytest.mark.parametrize("odometry", [False, True], ids=["radio", "odometry"])


class Problem(NamedTuple):
    """One update: prior, sensor, measured values, noise variances, what is visible."""

    x: np.ndarray
    P: np.ndarray
    sensor: textbook.Sensor
    z: np.ndarray
    R: np.ndarray
    visible: np.ndarray

    def ours(self, algorithm, gate, P=None):
        layout = Layout(self.sensor.links, self.sensor.odometry)
        measurement = Measurement(
            self.sensor.anchors.tolist(), HZ_PER_MPS, self.z.tolist(), self.R.tolist(),
            self.visible.astype(float).tolist(), layout,
        )  # fmt: skip
        P = self.P if P is None else P
        return algorithm(self.x.tolist(), P.tolist(), measurement, gate)

    def textbook(self, moments, gate, force=False):
        s = self.sensor
        return textbook.update(
            moments, s, s.groups, s.links, self.x, self.P, self.z, self.R, self.visible,
            gate.quantile, force, gate.robust,
        )  # fmt: skip


def numbers(low, high, shape=()):
    elements = st.floats(low, high, allow_subnormal=False)
    return hnp.arrays(float, shape, elements=elements) if shape else elements


@st.composite
def problems(draw, odometry=False, anchors=None, outliers=True):
    """Users 20 m and more off the vertical of every anchor, where nothing is singular."""
    L = draw(st.integers(1, 5)) if anchors is None else anchors
    position = draw(numbers(-200, 200, (3,)))
    heading, speed = draw(numbers(-3.14, 3.14)), draw(numbers(3.0 if odometry else 0.0, 20))
    velocity = [speed * np.cos(heading), speed * np.sin(heading), draw(numbers(-1, 1))]
    x = np.array([*position, *velocity, draw(numbers(-300, 300))])
    azimuth, distance = draw(numbers(-3.14, 3.14, (L,))), draw(numbers(20, 300, (L,)))
    height = draw(numbers(-20, 40, (L,)))
    offset = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
    sensor = textbook.Sensor(position + offset, HZ_PER_MPS, odometry)

    scale = np.array([3, 3, 1, 1, 1, 0.3, 50]) * draw(numbers(0.05, 1, (7,)))
    correlated = np.eye(7) + np.tril(draw(numbers(-0.5, 0.5, (7, 7))), -1)
    factor = scale[:, None] * correlated * (0.3 if odometry else 1.0)

    sigma = np.tile([1.0, 0.05, 0.05, 0.05], L).tolist() + [50.0] + [0.5, 0.1] * odometry
    sigma = np.array(sigma) * draw(numbers(0.05, 2, (len(sigma),)))
    wrong = st.sampled_from([0.0, 0.0, 0.0, 5.0] if outliers else [0.0])
    error = draw(numbers(-2, 2, sigma.shape)) + [draw(wrong) for _ in sigma]
    truth = x + factor @ draw(numbers(-2, 2, (7,)))
    angles = sensor.angles
    z = sensor.h(truth) + sigma * error
    z[angles] = (z[angles] + np.pi) % (2 * np.pi) - np.pi
    visible = draw(
        hnp.arrays(bool, len(sensor.groups), elements=st.sampled_from([True, True, False]))
    )
    P = factor @ factor.T
    # Beside the cut of an angle rounding decides on which side a residual falls.
    residual = sensor.difference(z, sensor.h(x))[angles]
    assume(np.all(np.abs(residual) < np.pi - 1e-3))
    return Problem(x, 0.5 * (P + P.T), sensor, z, sigma**2, visible)


def assert_same(ours, expected):
    """Equal to RTOL; the state in units of its standard deviations."""
    P = np.array(ours.P)
    sigma = np.sqrt(np.diag(expected.P))
    assert ours.accepted == expected.accepted.tolist()
    np.testing.assert_allclose((ours.x - expected.x) / sigma, 0.0, atol=RTOL)
    np.testing.assert_allclose((P - expected.P) / np.outer(sigma, sigma), 0.0, atol=RTOL)
    np.testing.assert_allclose(ours.nis, expected.nis, rtol=RTOL, atol=RTOL)
    np.testing.assert_allclose(ours.log_likelihood, expected.log_likelihood, rtol=RTOL, atol=RTOL)
    np.testing.assert_array_equal(P, P.T)


def assume_clear_of(nis, sensor, thresholds):
    """Rounding must not decide whether a group passes."""
    sizes = [g.stop - g.start for g in sensor.groups]
    for threshold in thresholds:
        assume(np.all(np.abs(nis - [threshold(size) for size in sizes]) > 1e-6))


@algorithms
@with_odometry
@pytest.mark.parametrize("gate", GATES.values(), ids=GATES)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_update_equals_textbook(algorithm, odometry, gate, data):
    problem = data.draw(problems(odometry))
    expected = problem.textbook(textbook.METHODS[algorithm], gate)
    if gate.quantile is not None:
        assume_clear_of(expected.nis, problem.sensor, [lambda n: chi2.ppf(gate.quantile, n)])
    assert_same(problem.ours(OURS[algorithm], gate), expected)


@algorithms
@with_odometry
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_robust_update_inflates_doubtful_links_and_gates_the_rest(algorithm, odometry, data):
    problem = data.draw(problems(odometry))
    gate = Gate(0.99, robust=True)
    expected = problem.textbook(textbook.METHODS[algorithm], gate)
    assume_clear_of(expected.nis, problem.sensor, [lambda n: chi2.ppf(0.99, n)])
    ours = problem.ours(OURS[algorithm], gate)
    assert_same(ours, expected)
    links = problem.sensor.links
    assert ours.accepted[:links] == problem.visible[:links].tolist()


@algorithms
@with_odometry
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_force_accepts_visible_links_alone(algorithm, odometry, data):
    problem = data.draw(problems(odometry))
    gate = Gate(0.5, force=1.0)
    expected = problem.textbook(textbook.METHODS[algorithm], gate, force=True)
    assume_clear_of(expected.nis, problem.sensor, [lambda n: chi2.ppf(0.5, n)])
    assert_same(problem.ours(OURS[algorithm], gate), expected)


@with_odometry
@pytest.mark.parametrize(
    "parameters", [(0.5, 2.0, 0.0), (1.0, 2.0, -4.0), (1.0, 2.0, 3.0)], ids=str
)
@given(data=st.data())
@settings(max_examples=30, deadline=None)
def test_any_scaled_sigma_points_equal_textbook(odometry, parameters, data):
    problem = data.draw(problems(odometry))

    def ours(x, P, measurement, gate):
        return update(x, P, measurement, gate, SigmaPoints(*parameters))

    expected = problem.textbook(textbook.unscented(*parameters), Gate(None))
    assume(np.all(np.linalg.eigvalsh(expected.P) > 0.0))
    assert_same(problem.ours(ours, Gate(None)), expected)


@pytest.mark.parametrize(
    ("algorithm", "moments"),
    [
        # Columns of L that vanish leave a UKF of n = 7 with the reach of n + kappa = 7.
        ("ekf", textbook.tangent),
        ("ukf", textbook.unscented(1.0, 2.0, 2.0)),
        ("ckf", textbook.unscented(1.0, 0.0, 2.0)),
    ],
)
@with_odometry
@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_planar_update_is_that_of_the_five_free_states(algorithm, moments, odometry, data):
    problem, gate = data.draw(problems(odometry)), Gate(0.99)
    free, pinned = [0, 1, 3, 4, 6], [2, 5]
    P = problem.P.copy()
    P[pinned, :] = P[:, pinned] = 0.0
    s = problem.sensor
    expected = textbook.update(
        moments, textbook.Restricted(s, problem.x, free), s.groups, s.links, problem.x[free],
        P[np.ix_(free, free)], problem.z, problem.R, problem.visible, gate.quantile,
    )  # fmt: skip
    assume_clear_of(expected.nis, s, [lambda n: chi2.ppf(0.99, n)])
    ours = problem.ours(OURS[algorithm], gate, P)
    whole = np.array(ours.P)
    reduced = whole[np.ix_(free, free)]
    assert_same(ours._replace(x=np.array(ours.x)[free], P=reduced), expected)
    assert [ours.x[i] for i in pinned] == problem.x[pinned].tolist()
    assert not whole[pinned].any()
    assert not whole[:, pinned].any()


@algorithms
@with_odometry
@given(data=st.data())
@settings(max_examples=20, deadline=None)
def test_nothing_visible_leaves_the_prior(algorithm, odometry, data):
    problem = data.draw(problems(odometry))
    problem = problem._replace(visible=np.zeros_like(problem.visible))
    posterior = problem.ours(OURS[algorithm], Gate(0.99))
    sigma = np.sqrt(np.diag(problem.P))
    assert posterior.log_likelihood == 0.0
    assert not any(posterior.accepted)
    np.testing.assert_allclose((posterior.x - problem.x) / sigma, 0.0, atol=1e-12)
    np.testing.assert_allclose(
        (np.array(posterior.P) - problem.P) / np.outer(sigma, sigma), 0.0, atol=1e-12
    )


@algorithms
@given(data=st.data())
@settings(max_examples=20, deadline=None)
def test_numbers_of_a_missing_group_do_not_matter(algorithm, data):
    problem = data.draw(problems(odometry=True, anchors=3))
    missing = ~np.repeat(problem.visible, [g.stop - g.start for g in problem.sensor.groups])
    blanked = problem._replace(
        z=np.where(missing, 0.0, problem.z), R=np.where(missing, 1.0, problem.R)
    )
    a, b = (p.ours(OURS[algorithm], Gate(0.99)) for p in (problem, blanked))
    assert (a.x, a.P, a.accepted) == (b.x, b.P, b.accepted)
    assert a.log_likelihood == pytest.approx(b.log_likelihood, rel=1e-12, abs=1e-12)


def link_to_the_east(azimuth_of_arrival, azimuth_of_departure):
    """One anchor 100 m to the east, so that arrival (pi) and departure (0) lie on a cut."""
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
def test_fused_azimuths_keep_the_nis_of_four_rows_across_the_cut(algorithm, arrival, departure):
    problem = link_to_the_east(arrival, departure)
    ours = problem.ours(OURS[algorithm], Gate(None))
    mean, S, _ = textbook.METHODS[algorithm](problem.sensor, problem.x, problem.P)
    S = (S + np.diag(problem.R))[:4, :4]
    y = problem.sensor.difference(problem.z, mean)[:4]
    assert np.all(np.abs(y[[1, 3]]) < 0.1)
    assert ours.nis[0] == pytest.approx(y @ np.linalg.inv(S) @ y, rel=1e-9)
    assert_same(ours, problem.textbook(textbook.METHODS[algorithm], Gate(None)))


def test_disagreeing_azimuths_are_gated_though_their_mean_fits():
    agreeing, disagreeing = link_to_the_east(np.pi, 0.0), link_to_the_east(-np.pi + 0.15, -0.1)
    assert agreeing.ours(ekf, Gate(0.99)).accepted[0] == 1.0
    assert disagreeing.ours(ekf, Gate(0.99)).accepted[0] == 0.0


@given(problem=problems(odometry=True))
@settings(max_examples=50, deadline=None)
def test_textbook_jacobian_is_the_derivative(problem):
    s, x = problem.sensor, problem.x
    step = 1e-4 * np.eye(7)
    columns = [s.difference(s.h(x + e), s.h(x - e)) / 2e-4 for e in step]
    np.testing.assert_allclose(s.jacobian(x), np.array(columns).T, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("alpha", "kappa"), [(0.0, 0.0), (-1.0, 0.0), (1.0, -7.0)])
def test_sigma_points_without_reach_are_refused(alpha, kappa):
    with pytest.raises(ValueError, match="alpha > 0"):
        SigmaPoints(alpha, 2.0, kappa)
