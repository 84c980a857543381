"""Tests that modes, memory and IMMs on plain floats equal their textbook formulas.

Engines compile the tested functions. The tests run the functions as plain Python, because
compilation would take longer than a test, which takes at most a second.
"""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from mmwave_env.filters import imm, memory, textbook
from mmwave_env.filters.gating import Gate
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, measurement_of, predict_update
from mmwave_env.filters.update import ModeResult, capped_log_likelihood
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site
from mmwave_env.models.motion import accelerate, turn
from mmwave_env.numerics.linalg import pack
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import blank_incoming
from tests.filters.gated_textbook import textbook_imm
from tests.filters.problems import HZ_PER_MPS, assert_same, assume_clear_of, problems
from tests.filters.tracks import process_noise, simulated, unpacked

few = settings(max_examples=6, deadline=None)


def epoch_of(problem, dt=0.7, snr_db=20.0, spread_hz=300.0):
    visible = problem.visible.astype(float).tolist()
    rows = problem.z.tolist(), np.sqrt(problem.R).tolist(), visible
    return Epoch(dt, *rows, [snr_db] * problem.sensor.links, spread_hz)


def layout_of(problem):
    return Layout(problem.sensor.links, problem.sensor.odometry)


MODES = [
    Mode("adaptive", "ekf", spread_gain=0.003),
    Mode("plain", "ukf", adaptive=False, coupling=False, gate=0.9, recovery=None),
    Mode("forced", "ckf", gate=0.5, recovery=3),
    Mode("robust", "ekf", robust=True, blockage_aware=True),
    Mode("hasty", "ekf", gate=None, acceleration_mps2=1.2),
    Mode("turning", "ekf", gate=None, turn_rate_radps=0.4),
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
    Q = process_noise(mode, epoch.dt, 300.0, scale)
    x, P = textbook.predict(problem.x, problem.P, Q, epoch.dt)
    if mode.acceleration_mps2:
        x = np.array(accelerate(x.tolist(), mode.acceleration_mps2, epoch.dt))
    if mode.turn_rate_radps:
        x = np.array(turn(x.tolist(), mode.turn_rate_radps, epoch.dt))
    R = scale * problem.R
    if mode.blockage_aware:
        R[4:8] *= 1.0 + 3.0 * (drop_db - 6.0) / 6.0
    forced = mode.recovery is not None and lockout >= mode.recovery
    residual = problem.sensor.difference(problem.z, problem.sensor.h(x))
    assume(np.all(np.abs(residual[problem.sensor.angles]) < np.pi - 1e-3))
    predicted = problem._replace(x=x, P=P, R=R)
    gate = Gate(mode.gate, robust=mode.robust)
    expected = predicted.textbook(textbook.METHODS[mode.algorithm], gate, forced)
    if mode.gate is not None:
        assume_clear_of(expected.nis, problem.sensor, [lambda n: chi2.ppf(mode.gate, n)])
    site = Site(problem.sensor.anchors.tolist(), HZ_PER_MPS, problem.x.tolist(), [])
    belief = problem.x.tolist(), pack(problem.P.tolist())
    result = predict_update(Pipeline((mode,), layout), mode, *belief, before, epoch, site)
    assert_same(result._replace(P=unpacked(np.array(result.P))), expected)
    np.testing.assert_allclose(result.x_predicted, x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(unpacked(np.array(result.P_predicted)), P, rtol=1e-9, atol=1e-9)
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
    np.testing.assert_allclose(variance, [4.0 * factor] * 4 + [4.0])


def outcome(nis, accepted, passed=0.0, log_likelihood=0.0, x=(0.0,) * 7):
    return ModeResult(list(x), [], [], [], nis, accepted, passed, log_likelihood)


def test_memory_follows_its_definition_over_many_epochs():
    rng = np.random.default_rng(4)
    layout = Layout(2)
    modes = 3
    dt = 0.5
    dof = np.array([4.0, 4.0, 1.0])
    keep = np.array([0.6, 0.9])
    kept = memory.initial_memory(layout, modes)
    window = np.ones(10)
    average = np.ones(2)
    lockout = 0.0
    unfixed = 0.0
    snr = np.full(2, -100.0)
    spread = 0.0
    correction = np.zeros(2)
    preference = np.zeros((2, modes))
    assert kept.mode == 0.0 and kept.gamma == 1.0 and kept.unfixed_s == 0.0
    assert [kept.nis, kept.accepted, kept.rejected] == [[0.0] * 3] * 3
    for _ in range(60):
        visible = rng.random(3) < 0.6
        accepted = visible & (rng.random(3) < 0.6)
        nis = rng.chisquare(dof) * rng.choice([0.1, 1.0, 3.0]) * visible
        now_db = rng.uniform(-30, 30, 2)
        now_hz = rng.uniform(0, 300)
        likelihoods = rng.normal(0.0, 40.0, modes)
        x = rng.normal(0, 5, 7)
        before = rng.normal(0, 5, 7)
        passed = float(accepted[:2].sum()) * (rng.random() < 0.5)
        epoch = Epoch(dt, [], [], visible.astype(float).tolist(), now_db.tolist(), now_hz)
        candidates = [outcome([0.0] * 3, [0.0] * 3, log_likelihood=v) for v in likelihoods]
        kept = memory.memory_before(kept, candidates, epoch, layout)
        chosen = outcome(nis.tolist(), accepted.astype(float).tolist(), passed, x=x)
        kept = memory.memory_after(layout, 2.0, before.tolist(), chosen, kept, epoch)

        grown = np.where(snr == -100.0, now_db, 0.95 * snr + 0.05 * now_db)
        snr = np.where(visible[:2], grown, snr)
        spread = 0.8 * spread + 0.2 * now_hz
        keeps = np.array([[0.6], [0.85]])
        difference = np.clip(likelihoods - likelihoods[-1], -30, 30)
        preference = keeps * preference + (1 - keeps) * difference
        if accepted.any():
            ratio = nis[accepted].sum() / dof[accepted].sum()
            window = np.array([ratio, *window[:-1]])
            average = keep * average + (1 - keep) * ratio
        lockout = 0.0 if passed else lockout + visible[:2].any()
        unfixed = 0.0 if accepted[:2].any() else unfixed + dt
        step = x[:2] - (before[:2] + dt * before[3:5])
        v = before[3:5]
        ahead = v / np.sqrt(v @ v + 1e-6)
        correction = 0.8 * correction + 0.2 * np.array(
            [step @ ahead, ahead[0] * step[1] - ahead[1] * step[0]]
        )
        gamma = np.clip(window.mean(), 0.5, 2.0)
        rejected = visible & ~accepted
        in_epoch = (nis, accepted, rejected)
        averages = (average, correction, unfixed, snr, spread)
        expected = memory.Memory(2.0, lockout, window, gamma, *in_epoch, *averages, preference)
        for name, value in expected._asdict().items():
            np.testing.assert_allclose(getattr(kept, name), value, rtol=1e-9, err_msg=name)


def test_the_nis_of_outliers_is_limited_to_a_quantile_when_modes_are_compared():
    cap = chi2.ppf(0.999, [4, 4, 1])
    nis = np.array([3.0, 50.0, 40.0])
    capped = capped_log_likelihood(
        outcome(nis.tolist(), [], log_likelihood=-50.0), Layout(2).widths
    )
    assert capped == pytest.approx(-50.0 + 0.5 * np.maximum(nis - cap, 0.0).sum())


def run_imm(modes, episode, transition, limits=(np.inf,) * 4):
    """Run an IMM on floats; yield the result and the time step dt of every epoch."""
    pipeline = Pipeline(tuple(modes), Layout(3))
    P = pack(episode.prior_covariance.tolist())
    tunings = [mode.tuning for mode in modes]
    rows = imm.ImmSettings([list(row) for row in transition], tunings, list(limits))
    mixture = imm.begin(pipeline, episode.prior_mean.tolist(), P)
    site = Site(
        episode.scene_anchors_m.tolist(), episode.hz_per_mps, episode.prior_mean.tolist(), P
    )
    for t in range(len(episode)):
        dt = episode.time_s[t] - episode.time_s[t - 1] if t else 0.0
        row = unflatten(blank_incoming(episode.layout), iter(episode.table()[t].tolist()))
        epoch = row.epoch(episode.layout)._replace(dt=float(dt))
        now = imm.imm_epoch(pipeline, rows, mixture, epoch, site)
        mixture = now.mixture
        yield now, float(dt)


@pytest.mark.parametrize(("nis_quantile", "off_m"), [(1.0, 0.0), (0.9, 0.0), (1.0, 90.0)])
def test_a_mixture_equals_the_textbook(nis_quantile, off_m):
    """Check also a range that is 90 m off: without logarithms, all likelihoods would underflow."""
    (episode,) = simulated(1, epochs=8)
    episode.measurement[:, 4] += off_m
    plain = {"gate": None, "adaptive": False, "coupling": False}
    tunings = [("ekf", 0.3), ("ekf", 4.0), ("ukf", 1.0)]
    modes = [Mode(f"{a} {v}", a, sigma_v=v, **plain) for a, v in tunings]
    transition = np.array([[0.9, 0.06, 0.04], [0.2, 0.7, 0.1], [0.3, 0.3, 0.4]])
    drift = modes[0].sigma_b_mps * episode.hz_per_mps
    per_mode = [(a, np.diag(np.square([0.1, 0.1, 0.02, v, v, 0.03, drift]))) for a, v in tunings]
    limits = chi2.ppf(nis_quantile, [4, 4, 4, 1])
    expected = textbook_imm(episode, per_mode, [transition] * len(episode), nis_quantile)
    for (now, _), x, P, probability in zip(
        run_imm(modes, episode, transition, limits), *expected, strict=True
    ):
        mean, covariance = imm.estimate(now.mixture)
        sigma = np.sqrt(np.diag(P))
        np.testing.assert_allclose((mean - x) / sigma, 0.0, atol=1e-7)
        np.testing.assert_allclose((covariance - P) / np.outer(sigma, sigma), 0.0, atol=1e-8)
        np.testing.assert_allclose(now.mixture.probability, probability, rtol=1e-7, atol=1e-9)
        best = imm.most_probable(now.mixture)
        assert best == np.argmax(probability)
        chosen = imm.most_probable_memory(now.mixture)
        assert chosen == now.mixture.tracks[int(best)].memory._replace(mode=best)


def test_the_prediction_of_a_mixture_has_the_moments_of_its_modes_and_their_maneuvers():
    (episode,) = simulated(1, epochs=5)
    modes = [Mode("a", sigma_v=0.3), Mode("b", acceleration_mps2=2.0)]
    for now, dt in run_imm(modes, episode, [[0.8, 0.2], [0.3, 0.7]]):
        x, P = imm.prediction(now, dt, HZ_PER_MPS)
        weights = np.array(now.predicted)
        F = textbook.F(dt)
        moved = np.array([F @ mixed for mixed in now.mixed])
        shifts = np.array([result.x_predicted for result in now.results]) - moved
        each = unpacked(np.array([result.P_predicted for result in now.results]))
        covariance = np.einsum("m,mij->ij", weights, each) + spread(weights, moved)
        np.testing.assert_allclose(x, weights @ (moved + shifts), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            unpacked(np.array(P)), covariance + spread(weights, shifts), rtol=1e-9, atol=1e-9
        )


def spread(weights, points):
    offset = points - weights @ points
    return np.einsum("m,mi,mj->ij", weights, offset, offset)


def test_the_stay_matrix_gives_all_changes_of_the_mode_the_same_probability():
    np.testing.assert_allclose(imm.stay_matrix(3), 0.025 + 0.925 * np.eye(3))
    assert imm.stay_matrix(1) == [[1.0]]


def test_transition_probabilities_per_second_are_scaled_to_shorter_steps():
    matrix = [[0.9, 0.1], [0.4, 0.6]]
    np.testing.assert_allclose(imm.over_step(matrix, 0.25), [[0.975, 0.025], [0.1, 0.9]])
    for dt in (0.0, 1.0, 7.0):
        np.testing.assert_allclose(imm.over_step(matrix, dt), matrix)


def test_the_probability_of_a_mode_can_be_raised_even_from_zero():
    track = imm.ModeTrack([], [], None)
    raised = imm.trusting(imm.Mixture([track] * 2, [1.0, 0.0]), 1.0, 1.0)
    assert 0.0 < raised.probability[1] == pytest.approx(1e-12 / np.exp(3.0), rel=1e-6)
