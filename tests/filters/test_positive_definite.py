"""Slow tests that covariances stay finite and positive definite under randomly switched modes."""

import numpy as np
import pytest

from mmwave_env.engines.env_engine import Engine
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.layout import Layout
from tests.filters.tracks import simulated, unpacked

MODES = (
    Mode("tight ekf", "ekf", sigma_p=0.01, sigma_v=0.05),
    Mode("ukf", "ukf", sigma_v=1.8),
    Mode("ckf", "ckf", sigma_v=1.8),
    Mode("wide ukf", "ukf", sigma_v=5.0, spread_gain=0.01, coupling=False),
    Mode("robust ekf", "ekf", sigma_v=0.3, robust=True, blockage_aware=True),
    Mode("robust ckf", "ckf", sigma_v=1.0, robust=True, blockage_aware=True),
    Mode("re-acquire", "ukf", sigma_v=1.8, gate=None),
)


@pytest.fixture(scope="module")
def pipeline():
    """Return a pipeline with modes of every kind."""
    return Pipeline(MODES, Layout(3))


def smallest_eigenvalues(pipeline, episodes, actions):
    """Return the smallest eigenvalue of any P in a run, and that of any correlation matrix."""
    engine = Engine(pipeline, len(episodes), TrackingReward(), "prior")
    engine.reset(episodes)
    smallest, smallest_scaled = np.inf, np.inf
    for action in actions:
        engine.step(action)
        P = unpacked(engine.read(engine.at.P))
        assert np.isfinite(engine.read(engine.at.x)).all()
        assert np.isfinite(P).all()
        sigma = np.sqrt(np.einsum("...ii->...i", P))
        correlation = P / (sigma[..., :, None] * sigma[..., None, :])
        smallest = min(smallest, np.linalg.eigvalsh(P).min())
        smallest_scaled = min(smallest_scaled, np.linalg.eigvalsh(correlation).min())
    return smallest, smallest_scaled


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "epochs"),
    [
        pytest.param(1000, 1000, id="a million epochs"),
        pytest.param(1, 50_000, id="one long track"),
    ],
)
def test_covariance_stays_positive_definite_under_random_modes(pipeline, n, epochs):
    episodes = simulated(n, epochs)
    # Modes are kept for a while, as by a policy, so that the P of tight modes becomes small.
    rng = np.random.default_rng(0)
    actions = np.repeat(rng.integers(len(MODES), size=(-(-epochs // 20), n)), 20, axis=0)[:epochs]
    every_epoch = rng.random((epochs, n)) < 0.2
    actions = np.where(every_epoch, rng.integers(len(MODES), size=(epochs, n)), actions)
    smallest, smallest_scaled = smallest_eigenvalues(pipeline, episodes, actions)
    assert smallest > 0.0
    assert smallest_scaled > 1e-12
