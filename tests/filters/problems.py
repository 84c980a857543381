"""Random update problems, to be solved by a shipped filter and by its textbook version."""

from typing import NamedTuple

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2

from mmwave_env.filters import Gate, textbook
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Measurement
from tests.filters import gated_textbook
from tests.filters.gated_textbook import Restricted, Rows, groups_of
from tests.filters.tracks import HZ_PER_MPS, wrapped

RTOL = 1e-9
GATES = [Gate(None), Gate(0.99), Gate(0.5), Gate(0.5, force=1.0), Gate(0.99, robust=True)]


class Problem(NamedTuple):
    """Update problem: prior, sensor, measured values, noise variances, mask of visible groups."""

    x: np.ndarray
    P: np.ndarray
    sensor: textbook.Sensor
    z: np.ndarray
    R: np.ndarray
    visible: np.ndarray
    measured: np.ndarray | None = None  # (rows,) mask; None if no row is missing

    @property
    def seen(self):
        """Return the textbook's sensor, restricted to the measured rows."""
        return self.sensor if self.measured is None else Rows(self.sensor, self.measured)

    def ours(self, algorithm, gate, P=None):
        partial = self.measured is not None
        sensor = self.sensor
        clock = "offset" if sensor.clock else "synchronized"
        layout = Layout(sensor.links, sensor.odometry, partial, clock)
        rows = self.z.tolist(), self.R.tolist(), self.visible.astype(float).tolist()
        if partial:
            shifted = np.eye(sensor.links)[sensor.shifted].tolist()
            more = self.measured.astype(float).tolist(), shifted
        else:
            more = ()
        measurement = Measurement(sensor.anchors.tolist(), HZ_PER_MPS, *rows, layout, *more)
        P = self.P if P is None else P
        return algorithm(self.x.tolist(), P.tolist(), measurement, gate)

    @property
    def update(self):
        """Return the arguments that follow the sensor in ``gated_textbook.update``."""
        rows = slice(None) if self.measured is None else self.measured
        visible = self.visible if self.measured is None else self.visible[self.visible]
        return self.x, self.P, self.z[rows], self.R[rows], visible

    @property
    def order(self):
        """Return the indices of the state's components in the order in which our filters factor P.

        The order changes the results of sigma points if measurements are nonlinear in the velocity.
        """
        return [0, 1, 2, 7, 3, 4, 5, 6] if self.sensor.clock else [*range(7)]

    def textbook(self, moments, gate, free=None):
        """Return the textbook's update of the ``free`` components; all others are known exactly.

        By default, all components are free.
        """
        free = self.order if free is None else free
        x, P, *measured = self.update
        model = Restricted(self.seen, x, free)
        prior = (x[free], P[np.ix_(free, free)])
        update = gated_textbook.update(moments, model, *prior, *measured, gate)
        back = np.argsort(free)
        return update._replace(x=update.x[back], P=update.P[np.ix_(back, back)])


def numbers(low, high, shape=()):
    elements = st.floats(low, high, allow_subnormal=False)
    return hnp.arrays(float, shape, elements=elements) if shape else elements


@st.composite
def problems(draw, odometry=False, anchors=None, partial=False, clock=False):
    """Draw a problem that is not singular: all anchors are at least 20 m away horizontally."""
    L = draw(st.integers(1, 5)) if anchors is None else anchors
    position = draw(numbers(-200, 200, (3,)))
    heading = draw(numbers(-3.14, 3.14))
    speed = draw(numbers(3.0 if odometry else 0.0, 20))
    velocity = [speed * np.cos(heading), speed * np.sin(heading), draw(numbers(-1, 1))]
    x = np.array([*position, *velocity, draw(numbers(-300, 300))])
    if clock:
        x = np.append(x, draw(numbers(-100, 100)))
    azimuth = draw(numbers(-3.14, 3.14, (L,)))
    distance = draw(numbers(20, 300, (L,)))
    height = draw(numbers(-20, 40, (L,)))
    offset = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
    shifted = draw(st.integers(0, L - 1)) if partial else 0
    sensor = textbook.Sensor(position + offset, HZ_PER_MPS, odometry, shifted, clock)

    n = len(x)
    scale = np.array([3, 3, 1, 1, 1, 0.3, 50, 30])[:n] * draw(numbers(0.05, 1, (n,)))
    correlated = np.eye(n) + np.tril(draw(numbers(-0.5, 0.5, (n, n))), -1)
    factor = scale[:, None] * correlated * (0.3 if odometry else 1.0)

    sigma = np.tile([1.0, 0.05, 0.05, 0.05], L).tolist() + [50.0] + [0.5, 0.1] * odometry
    sigma = np.array(sigma) * draw(numbers(0.05, 2, (len(sigma),)))
    wrong = st.sampled_from([0.0, 0.0, 0.0, 5.0])
    error = draw(numbers(-2, 2, sigma.shape)) + [draw(wrong) for _ in sigma]
    truth = x + factor @ draw(numbers(-2, 2, (n,)))
    angles = sensor.angles
    z = sensor.h(truth) + sigma * error
    z[angles] = wrapped(z[angles])
    visible = draw(
        hnp.arrays(bool, len(groups_of(sensor)), elements=st.sampled_from([True, True, False]))
    )
    P = factor @ factor.T
    # Near the cut at +-pi, rounding would decide the sign of an angle's residual.
    residual = sensor.difference(z, sensor.h(x))[angles]
    assume(np.all(np.abs(residual) < np.pi - 1e-3))
    measured = None
    if partial:
        measured = draw(hnp.arrays(bool, sigma.shape))
        assume(measured.any())
        visible = np.array([measured[group].any() for group in groups_of(sensor)])
    return Problem(x, 0.5 * (P + P.T), sensor, z, sigma**2, visible, measured)


def assert_same(ours, expected, rtol=RTOL, visible=None):
    """Assert that posteriors agree; x and P are compared in units of standard deviations.

    Args:
        visible: (groups,) mask of the groups in ``expected``; all others are rejected with NIS 0.
    """
    if visible is not None:
        assert not np.array([ours.nis, ours.accepted])[:, ~visible].any()
        nis, accepted = np.array([ours.nis, ours.accepted])[:, visible].tolist()
        ours = ours._replace(nis=nis, accepted=accepted)
    P = np.array(ours.P)
    sigma = np.sqrt(np.diag(expected.P))
    assert ours.accepted == expected.accepted.tolist()
    assert_allclose((ours.x - expected.x) / sigma, 0.0, atol=rtol)
    assert_allclose((P - expected.P) / np.outer(sigma, sigma), 0.0, atol=rtol)
    assert_allclose(ours.nis, expected.nis, rtol=rtol, atol=rtol)
    assert_allclose(ours.log_likelihood, expected.log_likelihood, rtol=rtol, atol=rtol)
    assert_array_equal(P, P.T)


def derivative(sensor, x, step):
    """Return the Jacobian (rows, n) of a sensor at x (n,), from central differences."""
    ends = [(sensor.h(x + e), sensor.h(x - e)) for e in step * np.eye(len(x))]
    columns = [sensor.difference(*each) / (2.0 * step) for each in ends]
    return np.array(columns).T


def assume_clear_of(nis, sensor, quantile):
    """Assume that no NIS is so near its gate that rounding decides whether its group passes."""
    if quantile is not None:
        thresholds = chi2.ppf(quantile, [g.stop - g.start for g in groups_of(sensor)])
        assume(np.all(np.abs(nis - thresholds) > 1e-6))
