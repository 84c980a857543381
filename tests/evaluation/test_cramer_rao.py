"""The posterior Cramer-Rao bound against filters on data of its own model, and against algebra.

Monte-Carlo checks of one test hold together at the 1 % level (Bonferroni), with seed 0.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from experiments.evaluation.cramer_rao import (
    Motion,
    averaged_bound,
    conditional_bounds,
    information,
    measured_motion,
    position_variance,
    recursion,
)
from mmwave_env.filters import textbook
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import (
    HZ_PER_MPS,
    STREET,
    OwnModel,
    far_from_the_anchors,
    imm_track,
    process_noise,
    simulated,
    track,
)
from tests.refusals import refuses

LEVEL, EPOCHS = 0.01, 30
PLAIN = {"gate": None, "adaptive": False, "sigma_v": 0.3}
MODES = [Mode(algorithm, algorithm, **PLAIN) for algorithm in ("ekf", "ukf", "ckf")]
AGILE = Mode("agile", "ukf", sigma_v=1.8)  # with gates and scaling
FILTERS = ("ekf", "ukf", "ckf", "imm")
DRIFT = 0.05
# What the modes' documented tuning says, per second: 0.1 and 0.02 m, 0.3 and 0.03 m/s.
MOTION = Motion([0.01, 0.01, 4e-4], [0.09, 0.09, 9e-4], (DRIFT * HZ_PER_MPS) ** 2)
RUNS = 2000


def street(radio):
    """Users of the default street; sigmas as at 15 dB but for fading, a fifth undetected."""
    scene, radio = SCENES["street"], RADIOS[radio]
    return OwnModel(
        sensor=textbook.Sensor(scene.anchors_m, HZ_PER_MPS),
        start=np.array([60.0, -60.0, 1.5, 3.0, 2.0, 0.0, 10.0]),
        prior=np.sqrt(np.diag(radio.prior_covariance(scene))),
        Q=process_noise(MODES[0]),
        sigma=radio.sigma(np.full((1, 3), 15.0), scene, STREET)[0],
        detection=0.8,
        fading=0.3,
    )


MODELS = {
    "easy": far_from_the_anchors(process_noise(MODES[0])),
    "missing": far_from_the_anchors(process_noise(MODES[0]), detection=0.7, fading=0.3),
    "handset": street("handset"),
    "standard": street("standard"),
}


@lru_cache
def filtered(model):
    """Squared position errors (T, RUNS) per filter, averaged bound (T,), conditional (RUNS, T)."""
    rng = np.random.default_rng(0)
    episodes = [MODELS[model].draw(rng, EPOCHS) for _ in range(RUNS)]
    truth = np.stack([episode.truth_position_m for episode in episodes], axis=1)
    single = Pipeline(tuple(MODES), STREET)
    x = {m.name: track(single, episodes, i, EPOCHS, ("x",))["x"] for i, m in enumerate(MODES)}
    x["imm"] = imm_track(Pipeline((MODES[0], AGILE), STREET), episodes)["x"]
    squared = {name: np.square(x[name][..., :3] - truth).sum(axis=-1) for name in FILTERS}
    averaged = position_variance(averaged_bound(episodes, MOTION))
    return squared, averaged, position_variance(conditional_bounds(episodes, MOTION))


def mean_and_error(squared):
    """Mean over runs of (..., runs), and its standard error."""
    return squared.mean(axis=-1), squared.std(axis=-1) / np.sqrt(squared.shape[-1])


# --- against filters


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.slow
def test_no_filter_beats_the_averaged_bound(model):
    squared, averaged, _ = filtered(model)
    z = norm.isf(LEVEL / (len(FILTERS) * (EPOCHS + 1)))
    for name in FILTERS:
        each_epoch, overall = mean_and_error(squared[name]), mean_and_error(squared[name].mean(0))
        assert np.all(each_epoch[0] + z * each_epoch[1] >= averaged), name
        assert overall[0] + z * overall[1] >= averaged.mean(), name


@pytest.mark.parametrize("name", ["ekf", "ukf"])
@pytest.mark.slow
def test_filters_reach_the_averaged_bound_in_an_easy_scene(name):
    squared, averaged, _ = filtered("easy")
    mean, error = mean_and_error(squared[name].mean(axis=0))
    assert np.sqrt((mean + norm.isf(LEVEL) * error) / averaged.mean()) < 1.05


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_filters_reach_the_mean_conditional_bound_everywhere(name, model):
    squared, _, conditional = filtered(model)
    # Paired: tracks with a high bound have large errors.
    excess, error = mean_and_error((squared[name].T - conditional).mean(axis=1))
    assert conditional.mean() + excess + norm.isf(LEVEL) * error < 1.05**2 * conditional.mean()


# --- against algebra


@pytest.mark.parametrize("vertical", [9e-4, 0.0])
def test_of_a_linear_model_it_is_the_kalman_filter_s_covariance(vertical):
    rng, T, rows = np.random.default_rng(0), 50, 4
    H, r = rng.normal(size=(T, rows, 7)), rng.uniform(0.5, 2.0, (T, rows))
    time_s = np.cumsum(rng.uniform(0.1, 2.0, T))
    prior = np.diag(rng.uniform(0.5, 3.0, 7))
    motion = Motion([0.02, 0.02, 0.0], [0.3, 0.3, vertical], 0.1)
    filter = KalmanFilter(7, rows)
    filter.P = prior.copy()
    expected = []
    for k, dt in enumerate([0.0, *np.diff(time_s)]):
        q = np.array(motion.velocity) * dt
        Q = np.diag([*(np.array(motion.position) * dt + q * dt**2 / 4), *q, motion.bias * dt])
        Q += np.diag([*(q * dt / 2), 0], k=3) + np.diag([*(q * dt / 2), 0], k=-3)
        filter.predict(F=textbook.F(dt), Q=Q)
        filter.update(np.zeros(rows), R=np.diag(r[k]), H=H[k])
        expected.append(filter.P.copy())
    fisher = np.einsum("tri,tr,trj->tij", H, 1.0 / r, H)
    bound = recursion(prior, time_s, fisher, motion)
    sigma = np.sqrt(np.einsum("tii->ti", expected))
    unit = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(bound / unit, expected / unit, rtol=0.0, atol=1e-9)
    both = recursion(prior, time_s, np.stack([fisher, 2.0 * fisher]), motion)
    np.testing.assert_allclose(both[0], bound, rtol=1e-12)
    np.testing.assert_allclose(both[1], recursion(prior, time_s, 2.0 * fisher, motion), rtol=1e-12)


def numerical_information(episode):
    """H' R^-1 H (T, 7, 7) with H from central differences of the textbook's h."""
    sensor = textbook.Sensor(episode.scene_anchors_m, episode.hz_per_mps, episode.layout.odometry)
    visible = np.repeat(episode.visible, [g.stop - g.start for g in sensor.groups], axis=1)
    x = np.column_stack([episode.truth_position_m, episode.truth_velocity_mps])
    fisher, step = [], 1e-4
    for state, keep, sigma in zip(np.pad(x, ((0, 0), (0, 1))), visible, episode.sigma, strict=True):
        columns = [
            sensor.difference(sensor.h(state + step * e), sensor.h(state - step * e)) / (2 * step)
            for e in np.eye(7)
        ]
        H = (np.array(columns).T / sigma[:, None])[keep]
        fisher.append(H.T @ H)
    return np.array(fisher)


def test_information_is_that_of_numerical_derivatives():
    for episode in simulated(3, epochs=40, odometry=True):
        fisher, expected = information(episode), numerical_information(episode)
        scale = np.sqrt(np.einsum("tii->ti", expected)) + 1e-12
        unit = scale[:, :, None] * scale[:, None, :]
        np.testing.assert_allclose(fisher / unit, expected / unit, rtol=0.0, atol=1e-6)


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    kept=st.floats(0.0, 1.0),
    louder=st.floats(1.0, 10.0),
    rougher=st.floats(1.0, 10.0),
)
def test_less_data_more_noise_or_rougher_motion_never_lower_the_bound(seed, kept, louder, rougher):
    rng = np.random.default_rng(seed)
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], epochs=8, odometry=True)
    more = source.sample(rng)
    less = replace(
        more,
        visible=more.visible & (rng.random(more.visible.shape) < kept),
        sigma=more.sigma * rng.uniform(1.0, louder, more.sigma.shape),
    )
    motion = Motion([0.01] * 3, [0.1, 0.1, 0.0], 1.0)
    rough = Motion([0.01 * rougher] * 3, [0.1 * rougher, 0.1, 0.0], rougher)
    low, high = averaged_bound([more], motion), averaged_bound([less], rough)
    unit = 1.0 / np.sqrt(np.einsum("tii->ti", high))
    difference = (high - low) * unit[:, :, None] * unit[:, None, :]
    assert np.linalg.eigvalsh(difference).min() >= -1e-9


def test_mean_conditional_bound_is_above_the_averaged_one():
    episodes = simulated(50, epochs=60)
    motion = measured_motion(episodes, DRIFT)
    averaged, conditional = averaged_bound(episodes, motion), conditional_bounds(episodes, motion)
    assert conditional.shape == (50, 60, 7, 7)
    unit = 1.0 / np.sqrt(np.einsum("tii->ti", averaged))
    difference = (conditional.mean(axis=0) - averaged) * unit[:, :, None] * unit[:, None, :]
    assert np.linalg.eigvalsh(difference).min() >= -1e-9
    assert position_variance(conditional).mean() > 1.2 * position_variance(averaged).mean()
    np.testing.assert_allclose(  # one track is its own mean
        averaged_bound(episodes[:1], motion), conditional_bounds(episodes[:1], motion)[0]
    )


# --- motion, and mistakes


def test_motion_is_measured_from_velocities():
    rng, model = np.random.default_rng(0), MODELS["easy"]
    motion = measured_motion([model.draw(rng, 100) for _ in range(50)], DRIFT)
    increments = 50 * 99
    margin = norm.isf(LEVEL / 4) * np.sqrt(2.0 / increments)  # of a relative variance
    np.testing.assert_allclose(motion.velocity, MOTION.velocity, rtol=margin)
    assert motion.velocity[0] == motion.velocity[1]
    assert motion.bias == pytest.approx(MOTION.bias) and motion.position == [0.0] * 3


def test_motion_is_per_second_and_flat_ground_has_none():
    (episode,) = simulated(1, epochs=4)
    velocity = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    time_s = np.array([0.0, 0.5, 1.0, 2.5])
    uneven = replace(episode, truth_velocity_mps=velocity, time_s=time_s)
    assert measured_motion([uneven], DRIFT).velocity == [1.0, 1.0, 0.0]
    (short,) = simulated(1, epochs=1)
    assert measured_motion([short], DRIFT).velocity == [0.0] * 3


def test_episodes_that_do_not_go_together_are_refused():
    first, other = simulated(2, epochs=5)
    unknown = replace(first, truth_velocity_mps=None)
    prior = replace(other, prior_covariance=2.0 * other.prior_covariance)
    slower = replace(other, time_s=2.0 * other.time_s)
    longer = simulated(1, epochs=6)
    for episodes in ([], [unknown], [first, prior], [first, slower], [first, *longer]):
        for bound in (averaged_bound, conditional_bounds):
            with refuses():
                bound(episodes, MOTION)
