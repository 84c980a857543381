"""Tests that tracks computed in one call equal tracks of the engine that stops at every epoch."""

import numpy as np
import pytest

from mmwave_env.engines.track_engine import Tracker
from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from tests.filters.tracks import STREET, simulated, track

N, T = 11, 60


@pytest.fixture(scope="module")
def episodes():
    return simulated(N, epochs=T)


@pytest.mark.parametrize("mode", default_modes())
def test_a_track_equals_that_of_the_stepping_engine(mode, episodes):
    pipeline = Pipeline((mode,), STREET)
    tracker = Tracker(pipeline, N)
    tracker.load(episodes)
    names = ("x", "P", "error", "nees", "memory.accepted")
    ours = tracker.run(*names)
    theirs = track(pipeline, episodes, 0, T, names)
    for name in names:
        np.testing.assert_allclose(ours[name], theirs[name].swapaxes(0, 1), rtol=1e-12, atol=1e-12)


def test_a_tracker_can_be_retuned_after_it_was_built(episodes):
    other = Mode("other", "ukf", sigma_v=0.7, sigma_p=0.3, spread_gain=0.01, coupling=False)
    tracker = Tracker(Pipeline((default_modes()[1],), STREET), N)
    tracker.load(episodes)
    as_built = tracker.run("x")["x"]
    tracker.tune([other.tuning])
    retuned = tracker.run("x")["x"]
    fresh = Tracker(Pipeline((other,), STREET), N)
    fresh.load(episodes)
    np.testing.assert_array_equal(retuned, fresh.run("x")["x"])
    assert np.abs(retuned - as_built).max() > 0.1


@pytest.mark.parametrize("on_floats", [False, True])
def test_actions_choose_the_mode_of_every_epoch(on_floats, episodes):
    pipeline = Pipeline(default_modes(), STREET)
    actions = np.random.default_rng(0).integers(0, 2, (3, T))
    tracker = Tracker(pipeline, 3, on_floats=on_floats)
    tracker.load(episodes[:3])
    ours = tracker.run("x", "memory.mode", actions=actions)
    np.testing.assert_array_equal(ours["memory.mode"], actions)
    expected = track(pipeline, episodes[:3], actions.T, T, ("x",))["x"]
    np.testing.assert_allclose(ours["x"], expected.swapaxes(0, 1), rtol=1e-11, atol=1e-11)
