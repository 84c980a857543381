"""Tests of replays, which run finished episodes again and smooth them."""

import numpy as np
import pytest

from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.replay import Replay, smooth
from mmwave_env.engines.track_engine import Tracker
from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.reward import TrackingReward
from tests.filters.tracks import STREET, simulated

N, T = 11, 60
ACTIONS = np.random.default_rng(0).integers(0, 2, (N, T)).astype(np.uint8)


def played(pipeline, episodes, actions, on_floats=False):
    """Return an engine at the end of the episodes, and its errors and NEES in all epochs."""
    engine = Engine(pipeline, len(episodes), TrackingReward(), on_floats=on_floats)
    engine.reset(episodes)
    errors, nees = [], []
    for chosen in actions.T:
        engine.step(chosen)
        errors.append(engine.read(engine.at.error))
        nees.append(engine.read(engine.at.nees))
    return engine, np.stack(errors, axis=1), np.stack(nees, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("planar", [False, True])
def test_a_replay_repeats_the_results_of_the_engine_and_smooths_them(planar):
    episodes = simulated(N, epochs=T)
    if planar:
        episodes = [e.on_flat_ground(float(e.truth_position_m[0, 2])) for e in episodes]
    pipeline = Pipeline(default_modes(), STREET, planar)
    engine, errors, nees = played(pipeline, episodes, ACTIONS)
    before = engine.column(3)
    again = Replay(pipeline).run(engine.batch.episodes(np.arange(N)), ACTIONS)
    np.testing.assert_array_equal(engine.column(3), before)
    np.testing.assert_allclose(again[0], errors, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again[1], nees, rtol=1e-9, atol=1e-9)

    tracker = Tracker(pipeline, N)
    tracker.load(episodes)
    run = tracker.run("x", "P", "x_predicted", "P_predicted", "error", actions=ACTIONS)
    predicted = run["x_predicted"], run["P_predicted"]
    x, _ = smooth(run["x"], run["P"], *predicted, np.ones(T - 1), planar)
    expected = run["error"] + (x - run["x"])[..., :3]
    np.testing.assert_allclose(again[2], expected, rtol=1e-9, atol=1e-9)
    assert np.abs(again[2] - again[0]).max() > 0.1


def test_a_replay_does_not_depend_on_the_other_episodes_or_their_order():
    pipeline = Pipeline(default_modes(), STREET)
    engine, *_ = played(pipeline, simulated(N, epochs=T), ACTIONS)
    replay, places = Replay(pipeline), np.arange(N)
    together = replay.run(engine.batch.episodes(places), ACTIONS)
    for some in ([4], [10, 0, 7], [8, 9, 10, 1, 2, 3, 4, 5, 6]):
        apart = replay.run(engine.batch.episodes(places[some]), ACTIONS[some])
        for a, b in zip(apart, together, strict=True):
            np.testing.assert_array_equal(a, b[some])


def test_an_episode_that_ends_early_is_smoothed_back_from_its_last_epoch():
    pipeline = Pipeline(default_modes(), STREET)
    engine, errors, _ = played(pipeline, simulated(2, epochs=T), ACTIONS[:2])
    errors_again, nees, smoothed = Replay(pipeline).run(
        engine.batch.episodes(np.arange(2)), ACTIONS[:2, :9]
    )
    assert errors_again.shape == smoothed.shape == (2, 9, 3) and nees.shape == (2, 9)
    np.testing.assert_allclose(errors_again, errors[:, :9], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(smoothed[:, -1], errors_again[:, -1])
