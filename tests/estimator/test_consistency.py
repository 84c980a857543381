"""Filters fed by their own model are as uncertain as they say.

Users move as the modes believe (white-noise acceleration, oscillator drift), start from the
prior and are measured with Gaussian noise, far enough from the anchors for the geometry to
be nearly flat across the prior. Then NEES and NIS are chi-square, whatever the algorithm.
Each test makes all its checks together at the 1 % level (Bonferroni), with seed 0.
"""

import numpy as np
import pytest
from scipy.stats import binom, chi2

from mmwave_env.engine import Engine
from mmwave_env.episode import Episode
from mmwave_env.estimator.modes import Mode
from mmwave_env.estimator.pipeline import Pipeline
from mmwave_env.measurement import Layout
from mmwave_env.reward import TrackingReward

from . import textbook

RUNS, EPOCHS, CHECKED = 2000, 40, (0, 1, 5, 10, 20, 39)
LEVEL = 0.01
ALGORITHMS = ("ekf", "ukf", "ckf")
ANCHORS = np.array([[-60.0, 120.0, 40.0], [160.0, 60.0, 60.0], [40.0, -150.0, 50.0]])
LAYOUT, SENSOR = Layout(3), textbook.Sensor(ANCHORS, 93.4)
DOF = [4, 4, 4, 1]
SIGMA = np.array([0.5, 0.02, 0.02, 0.02] * 3 + [20.0])
PRIOR = np.array([1.5, 1.5, 0.5, 1.0, 1.0, 0.1, 50.0])
TUNING = {"sigma_v": 0.3, "adaptive": False}


def process_noise(mode):
    """Q over a second, from the mode's documented tuning."""
    velocity = np.square([mode.sigma_v, mode.sigma_v, mode.sigma_vz])
    position = np.square([mode.sigma_p, mode.sigma_p, mode.sigma_pz])
    drift = (mode.sigma_b_mps * SENSOR.hz_per_mps) ** 2
    Q = np.diag([*(position + velocity / 4), *velocity, drift])
    return Q + np.diag([*velocity / 2, 0], k=3) + np.diag([*velocity / 2, 0], k=-3)


def drawn_from_the_model(rng, Q):
    """An episode of the filters' own model."""
    noise = np.linalg.cholesky(Q)
    x = [np.array([20.0, 10.0, 1.5, 1.0, -0.5, 0.0, 30.0])]
    for _ in range(EPOCHS - 1):
        x.append(textbook.F(1.0) @ x[-1] + noise @ rng.standard_normal(7))
    x = np.array(x)
    z = np.array([SENSOR.h(state) for state in x]) + SIGMA * rng.standard_normal((EPOCHS, 13))
    z[:, SENSOR.angles] = np.remainder(z[:, SENSOR.angles] + np.pi, 2 * np.pi) - np.pi
    return Episode(
        name="own model",
        scene_anchors_m=ANCHORS,
        hz_per_mps=SENSOR.hz_per_mps,
        time_s=np.arange(EPOCHS) * 1.0,
        measurement=z,
        sigma=np.tile(SIGMA, (EPOCHS, 1)),
        visible=np.ones((EPOCHS, 4), bool),
        snr_db=np.full((EPOCHS, 3), 30.0),
        doppler_spread_hz=np.zeros(EPOCHS),
        prior_mean=x[0] + PRIOR * rng.standard_normal(7),
        prior_covariance=np.diag(PRIOR**2),
        truth_position_m=x[:, :3],
        truth_velocity_mps=x[:, 3:6],
        layout=LAYOUT,
    )


@pytest.fixture(scope="module")
def runs():
    """Per algorithm: NEES (T, runs), NIS (T, runs, groups), and what a 99 % gate would reject."""
    plain = [Mode(a, a, gate=None, **TUNING) for a in ALGORITHMS]
    gated = [Mode(f"{a} gated", a, gate=0.99, **TUNING) for a in ALGORITHMS]
    pipeline = Pipeline((*plain, *gated), LAYOUT)
    rng, Q = np.random.default_rng(0), process_noise(plain[0])
    episodes = [drawn_from_the_model(rng, Q) for _ in range(RUNS)]
    engine = Engine(pipeline, RUNS, TrackingReward())
    found = {}
    for m, algorithm in enumerate(ALGORITHMS):
        nees, nis, rejected = [], [], []
        engine.reset(episodes)
        for _ in range(EPOCHS):
            candidates = engine.at.candidates
            nis.append(engine.read(candidates[m].nis))
            rejected.append(1.0 - engine.read(candidates[m + len(ALGORITHMS)].accepted))
            engine.step(np.full(RUNS, m))
            nees.append(engine.read(engine.at.nees))
        found[algorithm] = np.array(nees), np.array(nis), np.array(rejected)
    return found


def assert_chi_square_means(means, dof):
    """Means over RUNS of chi-square values, all within their joint 99 % interval."""
    means, dof = np.broadcast_arrays(means, dof)
    tail = LEVEL / means.size / 2
    low, high = chi2.ppf([[tail], [1 - tail]], RUNS * dof.ravel()) / RUNS
    outside = (means.ravel() < low) | (means.ravel() > high)
    assert not outside.any(), np.stack([low, means.ravel(), high], axis=1)[outside]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_nees_of_the_position_is_chi_square(runs, algorithm):
    nees, _, _ = runs[algorithm]
    assert_chi_square_means(nees[list(CHECKED)].mean(axis=1), 3)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_nis_of_every_group_is_chi_square(runs, algorithm):
    _, nis, _ = runs[algorithm]
    assert_chi_square_means(nis[list(CHECKED)].mean(axis=1), DOF)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_gate_rejects_one_good_group_in_a_hundred(runs, algorithm):
    _, _, rejected = runs[algorithm]
    trials = RUNS * EPOCHS
    tail = LEVEL / len(DOF) / 2
    low, high = binom.ppf([tail, 1 - tail], trials, 0.01)
    counts = rejected.sum(axis=(0, 1))
    assert np.all((counts >= low) & (counts <= high)), (low, counts, high)
