"""Tests that beliefs stay finite and P positive definite with random modes and damaged episodes."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from experiments.evaluation.contenders import draw_episodes
from mmwave_env.engines.engine import Engine
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.bank import named_modes
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.layout import Layout, wrap_angles
from mmwave_env.models.radio import RADIOS
from mmwave_env.numerics.linalg import cholesky, unpack
from mmwave_env.world.mobility import MOBILITIES
from tests.filters.tracks import street_source

pytestmark = pytest.mark.slow

N = 128  # environments for each kind of user with each radio; together, they take 384,000 steps
PARTS = ("x", "P", "memory", "candidates", "observation", "reward", "nees", "distance")
STAY = (0.0, 0.95, 1.0)  # probabilities of keeping the mode; each environment draws one of them
EXTREME = (  # modes with much smaller or larger covariances than the named modes
    Mode("tight", "ekf", sigma_p=0.01, sigma_v=0.05),
    Mode("wide", "ukf", sigma_v=5.0, spread_gain=0.01, coupling=False),
    Mode("re-acquire", "ckf", sigma_v=1.8, gate=None),
)
MODES = (*named_modes().values(), *EXTREME)


def damaged(episode, rng):
    """Return the episode without links for some time, and with NaN, infinite and far-off values."""
    layout = episode.layout
    T = len(episode)
    missing = rng.random((T, len(layout.groups))) < 0.03
    for group in np.flatnonzero(rng.random(len(layout.groups)) < 0.4):
        begin = rng.integers(T)
        missing[begin : begin + rng.integers(5, 60), group] = True
    if rng.random() < 0.25:
        begin = rng.integers(T)
        missing[begin : begin + rng.integers(50, 150), : layout.anchors] = True
    z = episode.measurement.copy()
    hit = rng.random(episode.measurement.shape)
    far = hit < 0.005
    broken = (hit >= 0.005) & (hit < 0.008)
    off = rng.uniform(10.0, 1000.0, z.shape) * rng.choice([-1.0, 1.0], z.shape)
    z[far] += (off * episode.sigma)[far]
    wrap_angles(z, layout)
    z[broken] = rng.choice([np.nan, np.inf, -np.inf], broken.sum())
    return replace(episode, measurement=z, visible=episode.visible & ~missing)


def unsound(engine):
    """Return names of nonfinite parts; add "indefinite P" unless P is positive definite."""
    kinds = [name for name in PARTS if not np.isfinite(engine.read(getattr(engine.at, name))).all()]
    P = unpack(list(np.ascontiguousarray(engine.read(engine.at.P).T)))
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = cholesky(P)
        if not all((factor[i][i] > 0.0).all() for i in range(len(P))):
            kinds.append("indefinite P")
    return kinds


def soaked(modes, users, n, epochs=200):
    """Run damaged episodes in random modes; return the first epoch with unsound parts, or None."""
    engine = Engine(Pipeline(tuple(modes), Layout(3)), n, TrackingReward())
    for turn, (scenario, radio) in enumerate(users):
        rng = np.random.default_rng(turn)
        source = street_source(scenario, radio, epochs=epochs)
        seeds = range(turn * n, (turn + 1) * n)
        engine.load([damaged(episode, rng) for episode in draw_episodes(source, seeds)])
        engine.step()
        actions = rng.integers(len(modes), size=n)
        stay = rng.choice(STAY, n)
        for epoch in range(epochs):
            engine.step(actions)
            if kinds := unsound(engine):
                return f"{scenario}, {radio}, epoch {epoch}", kinds
            changed = rng.random(n) >= stay
            actions = np.where(changed, rng.integers(len(modes), size=n), actions)
    return None


def test_all_numbers_stay_finite_and_covariances_positive_definite():
    assert soaked(MODES, product(MOBILITIES, RADIOS), N) is None
    assert soaked(MODES, [("mixed", "handset")], 1, epochs=50_000) is None
