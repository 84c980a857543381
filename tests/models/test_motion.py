"""Tests of prediction, process noise and maneuvers against textbook matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.filters import textbook
from mmwave_env.models.motion import (
    ProcessNoise,
    accelerate,
    move,
    predict_covariance,
    white_noise_acceleration,
)

variances = hnp.arrays(float, 3, elements=st.floats(0.0, 10.0))
states = hnp.arrays(float, 7, elements=st.floats(-300.0, 300.0))
steps = st.sampled_from([0.0, 0.1, 0.5, 1.0, 2.5])


def matrix(noise):
    """Return process noise as a matrix Q (7, 7)."""
    Q = np.diag(noise.diagonal)
    for i, covariance in enumerate(noise.coupling):
        Q[i, i + 3] = Q[i + 3, i] = covariance
    return Q


def written_out(position, velocity, bias, dt, coupled):
    """Return Q (7, 7) of a step, in which position, velocity and bias are random walks.

    If ``coupled``, the velocity changes evenly during the step, which also moves the user.
    """
    Q = np.diag([*(position * dt), 0.0, 0.0, 0.0, bias * dt])
    for i, q in enumerate(velocity * dt):
        effect = np.zeros(7)
        effect[i + 3] = 1.0
        effect[i] = dt / 2 if coupled else 0.0
        Q += q * np.outer(effect, effect)
    return Q


@pytest.mark.parametrize("coupled", [True, False])
@given(position=variances, velocity=variances, bias=st.floats(0.0, 1e4), dt=steps)
def test_process_noise_equals_the_textbook_and_is_semidefinite(
    position, velocity, bias, dt, coupled
):
    Q = matrix(white_noise_acceleration(position, velocity, bias, dt, coupled))
    expected = written_out(position, velocity, bias, dt, coupled)
    assert_allclose(Q, expected, rtol=1e-13, atol=1e-13)
    assert np.linalg.eigvalsh(Q)[0] >= -1e-12 * max(1.0, Q.max())


@given(
    x=states,
    factor=hnp.arrays(float, (7, 7), elements=st.floats(-3.0, 3.0)),
    diagonal=hnp.arrays(float, 7, elements=st.floats(0.0, 10.0)),
    coupling=hnp.arrays(float, 3, elements=st.floats(-5.0, 5.0)),
    dt=steps,
)
def test_prediction_equals_the_textbook_kalman_prediction(x, factor, diagonal, coupling, dt):
    noise = ProcessNoise(diagonal.tolist(), coupling.tolist())
    P = factor @ factor.T
    expected_x, expected_P = textbook.predict(x, P, matrix(noise), dt)
    predicted = np.array(predict_covariance(P.tolist(), noise, dt))
    assert_allclose(move(x.tolist(), dt), expected_x, rtol=1e-13, atol=1e-12)
    assert_allclose(predicted, expected_P, rtol=1e-12, atol=1e-11)
    assert_array_equal(predicted, predicted.T)


headings = st.floats(-np.pi, np.pi)


@given(x=states, heading=headings, speed=st.floats(5.0, 40.0), a=st.floats(-4.0, 4.0), dt=steps)
def test_a_fast_user_accelerates_along_the_velocity(x, heading, speed, a, dt):
    ahead = np.array([np.cos(heading), np.sin(heading)])
    x[3:5] = speed * ahead
    moved = np.array(accelerate(x.tolist(), a, dt))
    a = max(a, -speed / dt) if dt else a
    expected = x.copy()
    expected[:2] += 0.5 * a * dt**2 * ahead
    expected[3:5] += a * dt * ahead
    # The code smooths the direction at speeds near 0.2 m/s; at 5 m/s, a small effect remains.
    assert_allclose(moved, expected, atol=2e-3 * (1.0 + abs(a) * dt) * (1.0 + dt))


@given(heading=headings, speed=st.floats(0.0, 3.0), dt=st.floats(0.05, 5.0))
def test_braking_ends_at_a_standstill(heading, speed, dt):
    v = speed * np.array([np.cos(heading), np.sin(heading)])
    moved = np.array(accelerate([0.0, 0.0, 1.5, *v, 0.1, 7.0], -100.0, dt))
    assert_allclose(moved[3:5], 0.0, atol=1e-12)
    # Position 0, the input, already includes the unbraked movement dt v; braking undoes half of it.
    assert_allclose(moved[:2], -0.5 * dt * v, atol=1e-12)
    assert_array_equal(moved[[2, 5, 6]], [1.5, 0.1, 7.0])


@given(a=st.floats(-4.0, 4.0), dt=steps)
def test_a_user_at_rest_is_not_accelerated(a, dt):
    still = [3.0, 4.0, 1.5, 0.0, 0.0, 0.0, 7.0]
    assert accelerate(still, a, dt) == still
