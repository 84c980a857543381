"""Tests of signed features, which contain residuals along and across the user's motion."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from mmwave_env.engines.engine import Engine
from mmwave_env.engines.smoothing import GATES, smoothed_features
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.bank import Bank
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.interface.signed import after_update
from mmwave_env.models.layout import Layout
from mmwave_env.task import task_from
from mmwave_env.world.episode import EpisodeBatch

BANK = Bank((Mode("stand", sigma_v=0.1), Mode("ride", sigma_v=2.0)))  # quick to compile
PIPELINE = Pipeline(BANK.modes, Layout())
# names of the features that a policy gets in order to correct a belief
NAMES = [feature.name for feature in after_update(PIPELINE)]
EPOCHS = 40
N = 8


@pytest.fixture(scope="module")
def episodes():
    source = task_from(beliefs="per-mode", modes=BANK, episode_steps=EPOCHS).simulated
    return source.episodes(np.arange(5_000_000, 5_000_000 + N, dtype=np.uint64))


def played(episodes, actions):
    """Play episodes with actions (n, T) in an environment.

    Return the features NAMES (n, T, features) and the beliefs' means (n, T, 7).
    """
    engine = Engine(PIPELINE, len(episodes), TrackingReward(), "signed", BANK)
    engine.load(episodes)
    engine.step()
    columns = [engine.observation.names.index(name) for name in NAMES]
    observed = []
    x = []
    for now in actions.T:
        observations = engine.step(now)
        observed.append(observations[:, columns])
        x.append(engine.read(engine.at.x))
    return np.stack(observed, 1), np.stack(x, 1)


def random_actions():
    return np.random.default_rng(0).integers(3, size=(N, EPOCHS))


def test_features_of_a_track_that_smoothing_did_not_change_are_those_of_the_filter(episodes):
    actions = random_actions()
    observed, _ = played(episodes, actions)
    names = ("x", "P", "mixture", *(f"memory.{gate}" for gate in GATES))
    engine = Engine(PIPELINE, len(episodes), observation="", bank=BANK)
    batch = EpisodeBatch.of(episodes)
    engine.load(batch)
    x, P, mixtures, *gates = engine.run(*names, actions=actions).values()
    features = smoothed_features(PIPELINE, batch.table, batch.site, x, P, mixtures, gates)
    # A feature compares the heading with the previous epoch's heading; the first epoch has none.
    assert_allclose(features[:, 1:], observed[:, 1:], atol=1e-5)


def turned(episode, angle, offset):
    """Return an episode whose world is turned by an angle (rad), then moved by an offset (m)."""
    R = Rotation.from_euler("z", angle).as_matrix()
    whole = np.eye(7)  # the rotation of a whole state
    whole[:3, :3] = whole[3:6, 3:6] = R
    z = episode.measurement.copy()
    for anchor in range(3):
        z[:, [4 * anchor + 1, 4 * anchor + 3]] += angle
    prior = whole @ episode.prior_mean
    prior[:3] += offset
    return replace(
        episode,
        scene_anchors_m=episode.scene_anchors_m @ R.T + offset,
        measurement=z,
        prior_mean=prior,
        prior_covariance=whole @ episode.prior_covariance @ whole.T,
        truth_position_m=episode.truth_position_m @ R.T + offset,
        truth_velocity_mps=episode.truth_velocity_mps @ R.T,
    )


@settings(max_examples=5)
@given(st.floats(-3.0, 3.0), st.lists(st.floats(-300.0, 300.0), min_size=2, max_size=2))
def test_features_do_not_depend_on_place_or_direction(episodes, angle, offset):
    actions = random_actions()
    moved = [turned(episode, angle, np.array([*offset, 5.0])) for episode in episodes]
    before, _ = played(episodes, actions)
    after, _ = played(moved, actions)
    assert_allclose(after, before, atol=2e-4)


def test_residuals_equal_the_formula_in_numpy(episodes):
    observed, x = played(episodes, random_actions())
    table = Observation(PIPELINE, "signed", "per-mode")

    def value(name, i):
        """Return a feature (T,) in its own unit."""
        column = next(column for column in table.columns if column.name == name)
        return observed[i, :, NAMES.index(name)] * column.deviation + column.mean

    for i, episode in enumerate(episodes):
        step = x[i, :, :2] - episode.scene_anchors_m[1, :2]
        flat = np.linalg.norm(step, axis=1)
        bearing = np.arctan2(step[:, 1], step[:, 0])
        residual = flat * np.angle(np.exp(1j * (episode.measurement[:, 5] - bearing)))
        deviation = np.maximum(episode.sigma[:, 5] * flat, 0.05)
        q = np.sign(residual) * np.log1p(np.abs(residual) / deviation) * episode.visible[:, 1]
        heading = np.arctan2(x[i, :, 4], x[i, :, 3])
        ranges = []
        for anchor in range(3):
            distance = np.linalg.norm(x[i, :, :3] - episode.scene_anchors_m[anchor], axis=1)
            share = (episode.measurement[:, 4 * anchor] - distance) / episode.sigma[:, 4 * anchor]
            ranges.append(np.where(episode.visible[:, anchor], np.clip(share, -1.5, 1.5), np.nan))
        seen = np.isfinite(ranges).any(axis=0)
        mean = value("mean range residual", i)
        assert_allclose(mean[seen], np.nanmean(np.array(ranges)[:, seen], axis=0), atol=1e-4)
        assert (mean[~seen] == 0.0).all()
        # A positive residual points to the left of the ray from the anchor to the user; the cosine
        # projects it onto the direction to the left of the motion.
        expected = q * np.cos(bearing - heading)
        assert_allclose(value("azimuth residual across anchor 2", i), expected, atol=1e-4)


def test_features_do_not_depend_on_the_coming_epoch(episodes):
    """Change the measurements of the last epoch; features of earlier epochs must stay the same."""
    actions = random_actions()
    changed = EPOCHS - 1
    spoiled = []
    for episode in episodes:
        z = episode.measurement.copy()
        z[changed:, 0] += 5.0
        spoiled.append(replace(episode, measurement=z))
    before = played(episodes, actions)[0]
    after = played(spoiled, actions)[0]
    assert_array_equal(before[:, :changed], after[:, :changed])
    assert (before[:, changed] != after[:, changed]).any()
