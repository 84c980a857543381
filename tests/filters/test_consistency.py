"""Tests that covariances are right if motion and measurements are as the filters assume.

Users start from the prior and move as the modes assume (white-noise acceleration, oscillator
drift). Noise is Gaussian. Anchors are so far away that measurements are nearly linear across the
prior. NEES and NIS must then be chi-square for every algorithm, and errors must exceed
protection levels with the probability that the levels state.
Each test would fail by chance with 1 % of all seeds (Bonferroni over its checks); the seed is 0.
"""

import numpy as np
import pytest
from scipy.stats import binom, chi2

from mmwave_env.engines.engine import Engine
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.localization.position_errors import PositionErrors
from tests.filters.tracks import STREET, far_from_the_anchors, process_noise

RUNS = 1000
EPOCHS = 40
CHECKED = (0, 1, 5, 10, 20, 39)
LEVEL = 0.01
pytestmark = pytest.mark.slow
ALGORITHMS = ("ekf", "ukf", "ckf")
DOF = [4, 4, 4, 1]
TUNING = {"sigma_v": 0.3, "adaptive": False}
algorithms = pytest.mark.parametrize("algorithm", ALGORITHMS)


@pytest.fixture(scope="module")
def runs():
    """Return five arrays for each algorithm: NEES (T, runs), NIS (T, runs, groups), rejections by a
    99 % gate as 0 or 1 (T, runs, groups), errors (T, runs, 3) and packed P (T, runs, 28).
    """
    plain = [Mode(a, a, gate=None, **TUNING) for a in ALGORITHMS]
    gated = [Mode(f"{a} gated", a, gate=0.99, **TUNING) for a in ALGORITHMS]
    pipeline = Pipeline((*plain, *gated), STREET)
    rng = np.random.default_rng(0)
    model = far_from_the_anchors(process_noise(plain[0]))
    episodes = [model.draw(rng, EPOCHS) for _ in range(RUNS)]
    engine = Engine(pipeline, RUNS, TrackingReward())
    results = {}
    for m, algorithm in enumerate(ALGORITHMS):
        engine.load(episodes)
        engine.step()
        at = engine.at
        epochs = []
        for _ in range(EPOCHS):
            nis = engine.read(at.candidates[m].nis)
            rejected = 1.0 - engine.read(at.candidates[m + len(ALGORITHMS)].accepted)
            engine.step(np.full(RUNS, m))
            after = [engine.read(part) for part in (at.error, at.P)]
            epochs.append((engine.read(at.nees), nis, rejected, *after))
        results[algorithm] = tuple(map(np.array, zip(*epochs, strict=True)))
    return results


def assert_chi_square_means(means, dof):
    """Assert that means of RUNS chi-square values are all within their joint 99 % interval."""
    means, dof = np.broadcast_arrays(means, dof)
    tail = LEVEL / means.size / 2
    low, high = chi2.ppf([[tail], [1 - tail]], RUNS * dof.ravel()) / RUNS
    outside = (means.ravel() < low) | (means.ravel() > high)
    assert not outside.any(), np.stack([low, means.ravel(), high], axis=1)[outside]


@algorithms
def test_nees_of_the_position_is_chi_square(runs, algorithm):
    nees, *_ = runs[algorithm]
    assert_chi_square_means(nees[list(CHECKED)].mean(axis=1), 3)


@algorithms
def test_nis_of_every_group_is_chi_square(runs, algorithm):
    _, nis, *_ = runs[algorithm]
    assert_chi_square_means(nis[list(CHECKED)].mean(axis=1), DOF)


@algorithms
def test_gate_rejects_one_good_group_in_a_hundred(runs, algorithm):
    _, _, rejected, *_ = runs[algorithm]
    trials = RUNS * EPOCHS
    tail = LEVEL / len(DOF) / 2
    low, high = binom.ppf([tail, 1 - tail], trials, 0.01)
    counts = rejected.sum(axis=(0, 1))
    assert np.all((counts >= low) & (counts <= high)), (low, counts, high)


@algorithms
def test_errors_exceed_protection_levels_with_the_stated_probability(runs, algorithm):
    *_, errors, P = runs[algorithm]
    risks = (0.2, 0.05, 0.01)
    tail = LEVEL / (len(risks) * len(CHECKED) * 2) / 2  # two kinds: horizontal, vertical
    for risk in risks:
        low, high = binom.ppf([tail, 1 - tail], RUNS, risk)
        for epoch in CHECKED:  # episodes are independent, but epochs of one episode are not
            levels = PositionErrors(risk)
            levels.add(errors[epoch], P[epoch])
            for kind, figures in levels.figures().items():
                assert low <= figures["exceeded"] <= high, (risk, epoch, kind)
