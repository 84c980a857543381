"""Tests that modes, IMMs and corrections on plain floats equal their textbook formulas.

Engines compile the tested functions. The tests run the functions as plain Python, because
compilation would take longer than a test, which takes at most a second.
"""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mmwave_env.filters import Gate, Mode, Pipeline, imm, memory, predict_update, textbook
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import Frame, corrected, deviations_of
from mmwave_env.filters.pipeline import measurement_of
from mmwave_env.filters.update import ModeResult, capped_log_likelihood
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site
from mmwave_env.models.motion import accelerate
from mmwave_env.numerics.linalg import pack
from tests.filters.problems import HZ_PER_MPS, assert_same, assume_clear_of, problems
from tests.filters.tracks import process_noise, unpacked

few = settings(max_examples=6)


SPREAD_HZ = 300.0


def epoch_of(problem):
    visible = problem.visible.astype(float).tolist()
    rows = problem.z.tolist(), np.sqrt(problem.R).tolist(), visible
    return Epoch(0.7, *rows, [20.0] * problem.sensor.links, SPREAD_HZ)


def layout_of(problem):
    return Layout(problem.sensor.links, problem.sensor.odometry)


MODES = [
    Mode("adaptive", "ekf", spread_gain=0.003),
    Mode("plain", "ukf", adaptive=False, coupling=False, gate=0.9, recovery=None),
    Mode("forced", "ckf", gate=0.5, recovery=3),
    Mode("robust", "ekf", robust=True, blockage_aware=True),
    Mode("hasty", "ekf", gate=None, acceleration_mps2=1.2),
]


@pytest.mark.parametrize("lockout", [2.0, 3.0])
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@given(data=st.data())
@few
def test_an_epoch_of_a_mode_equals_the_textbook(mode, lockout, data):
    problem = data.draw(problems(odometry=True, anchors=2))
    epoch = epoch_of(problem)
    layout = layout_of(problem)
    gamma = 1.7
    drop_db = 9.0
    before = memory.initial_memory(layout, 1)._replace(
        gamma=gamma, lockout=lockout, snr_mean_db=[20.0, 20.0 + drop_db]
    )
    scale = gamma if mode.adaptive else 1.0
    Q = process_noise(mode, epoch.dt, SPREAD_HZ, scale)
    x, P = textbook.predict(problem.x, problem.P, Q, epoch.dt)
    if mode.acceleration_mps2:
        x = np.array(accelerate(x.tolist(), mode.acceleration_mps2, epoch.dt))
    R = scale * problem.R
    if mode.blockage_aware:
        R[4:8] *= 1.0 + 3.0 * (drop_db - 6.0) / 6.0
    forced = mode.recovery is not None and lockout >= mode.recovery
    residual = problem.sensor.difference(problem.z, problem.sensor.h(x))
    assume(np.all(np.abs(residual[problem.sensor.angles]) < np.pi - 1e-3))
    predicted = problem._replace(x=x, P=P, R=R)
    gate = Gate(mode.gate, forced, mode.robust)
    expected = predicted.textbook(textbook.METHODS[mode.algorithm], gate)
    assume_clear_of(expected.nis, problem.sensor, mode.gate)
    site = Site(problem.sensor.anchors.tolist(), HZ_PER_MPS, problem.x.tolist(), [])
    belief = problem.x.tolist(), pack(problem.P.tolist())
    result = predict_update(Pipeline((mode,), layout), mode, *belief, before, epoch, site)
    assert_same(result._replace(P=unpacked(np.array(result.P))), expected)
    assert_allclose(result.x_predicted, x, rtol=1e-12, atol=1e-12)
    assert_allclose(unpacked(np.array(result.P_predicted)), P, rtol=1e-9, atol=1e-9)
    within = expected.nis[:2] <= (np.inf if mode.gate is None else chi2.ppf(mode.gate, 4))
    passed = problem.visible[:2] & (within | mode.robust)
    assert result.passed == passed.sum()


@pytest.mark.parametrize(("now_db", "factor"), [(19.0, 1.0), (11.0, 2.5), (-30.0, 10.0)])
def test_a_blockage_aware_mode_inflates_the_noise_of_a_link_with_low_snr(now_db, factor):
    mode = Mode("aware", blockage_aware=True)
    layout = Layout(1)
    before = memory.initial_memory(layout, 1)._replace(snr_mean_db=[20.0])
    epoch = Epoch(1.0, [0.0] * 5, [2.0] * 5, [1.0, 1.0], [now_db], 0.0)
    site = Site([[0.0, 0.0, 6.0]], HZ_PER_MPS, [0.0] * 7, [])
    variance = measurement_of(mode, before, epoch, site, layout).variance
    assert_allclose(variance, [4.0 * factor] * 4 + [4.0])


def test_the_nis_of_outliers_is_limited_to_a_quantile_when_modes_are_compared():
    cap = chi2.ppf(0.999, [4, 4, 1])
    nis = np.array([3.0, 50.0, 40.0])
    result = ModeResult([], [], [], [], nis.tolist(), [], 0.0, -50.0)
    capped = capped_log_likelihood(result, Layout(2).widths)
    assert capped == pytest.approx(-50.0 + 0.5 * np.maximum(nis - cap, 0.0).sum())


def test_the_stay_matrix_gives_all_changes_of_the_mode_the_same_probability():
    assert_allclose(imm.stay_matrix(3), 0.025 + 0.925 * np.eye(3))
    assert imm.stay_matrix(1) == [[1.0]]


def test_transition_probabilities_per_second_are_scaled_to_shorter_steps():
    matrix = [[0.9, 0.1], [0.4, 0.6]]
    assert_allclose(imm.over_step(matrix, 0.25), [[0.975, 0.025], [0.1, 0.9]])
    for dt in (0.0, 1.0, 7.0):
        assert_allclose(imm.over_step(matrix, dt), matrix)


def test_the_probability_of_a_mode_can_be_raised_even_from_zero():
    raised = imm.trusting(imm.Mixture([], [], [], [1.0, 0.0]), 1.0, 1.0)
    assert 0.0 < raised.probability[1] == pytest.approx(1e-12 / np.exp(3.0), rel=1e-6)


# --- corrections of a belief, which equal products of matrices in numpy

ANGLE = st.floats(-3.1, 3.1)
SHIFT = st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3)
LOG_FACTOR = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3)


def belief_of(seed=0, angle=0.5, axes=(0, 1, 2)):
    """Return a belief with a random covariance; ``angle`` (rad) is the direction of motion."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(7, 7))
    x = rng.normal(size=7)
    x[3:5] = 3.0 * np.cos(angle), 3.0 * np.sin(angle)
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
