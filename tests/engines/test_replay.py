"""Tests of replays, which run finished episodes again and smooth them."""

import numpy as np
import pytest

from mmwave_env.engines.replay import Replay, smooth
from mmwave_env.engines.track_engine import Tracker
from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.world.episode import EpisodeBatch
from tests.filters.tracks import STREET, simulated, track

N, T = 11, 60
ACTIONS = np.random.default_rng(0).integers(0, 2, (N, T)).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("planar", [False, True])
def test_a_replay_repeats_the_results_of_the_engine_and_smooths_them(planar):
    episodes = simulated(N, epochs=T)
    if planar:
        episodes = [e.on_flat_ground(float(e.truth_position_m[0, 2])) for e in episodes]
    pipeline = Pipeline(default_modes(), STREET, planar)
    played = track(pipeline, episodes, ACTIONS.T, T, ("error", "nees"))
    error, nees, smoothed = Replay(pipeline).run(EpisodeBatch.of(episodes), ACTIONS)
    np.testing.assert_allclose(error, played["error"].swapaxes(0, 1), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(nees, played["nees"].swapaxes(0, 1), rtol=1e-9, atol=1e-9)

    tracker = Tracker(pipeline, N)
    tracker.load(episodes)
    run = tracker.run("x", "P", "x_predicted", "P_predicted", "error", actions=ACTIONS)
    predicted = run["x_predicted"], run["P_predicted"]
    x, _ = smooth(run["x"], run["P"], *predicted, np.ones(T - 1), planar)
    expected = run["error"] + (x - run["x"])[..., :3]
    np.testing.assert_allclose(smoothed, expected, rtol=1e-9, atol=1e-9)
    assert np.abs(smoothed - error).max() > 0.1


def test_a_replay_does_not_depend_on_the_other_episodes_or_their_order():
    episodes, replay = simulated(N, epochs=T), Replay(Pipeline(default_modes(), STREET))
    together = replay.run(EpisodeBatch.of(episodes), ACTIONS)
    for some in ([4], [10, 0, 7], [8, 9, 10, 1, 2, 3, 4, 5, 6]):
        apart = replay.run(EpisodeBatch.of([episodes[i] for i in some]), ACTIONS[some])
        for a, b in zip(apart, together, strict=True):
            np.testing.assert_array_equal(a, b[some])


def test_an_episode_that_ends_early_is_smoothed_back_from_its_last_epoch():
    episodes, replay = simulated(2, epochs=T), Replay(Pipeline(default_modes(), STREET))
    whole, *_ = replay.run(EpisodeBatch.of(episodes), ACTIONS[:2])
    error, nees, smoothed = replay.run(EpisodeBatch.of(episodes), ACTIONS[:2, :9])
    assert error.shape == smoothed.shape == (2, 9, 3) and nees.shape == (2, 9)
    np.testing.assert_array_equal(error, whole[:, :9])
    np.testing.assert_array_equal(smoothed[:, -1], error[:, -1])
