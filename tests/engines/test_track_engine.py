"""Tests that tracks computed in one call equal tracks of the engine that stops at every epoch."""

import numpy as np
import pytest

from mmwave_env.engines.engine import tracks_of
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import default_modes
from tests.filters.tracks import STREET, simulated, track

N = 11
T = 60


@pytest.fixture(scope="module")
def episodes():
    return simulated(N, epochs=T)


@pytest.mark.parametrize(("on_floats", "n", "tolerance"), [(False, N, 1e-12), (True, 3, 1e-11)])
def test_a_track_equals_the_track_of_the_engine_that_stops_at_every_epoch(
    on_floats, n, tolerance, episodes
):
    pipeline = Pipeline(default_modes(), STREET)
    actions = np.random.default_rng(0).integers(0, 2, (n, T))
    # two tracks do not switch modes
    actions[0] = 0
    actions[1] = 1
    tracker = tracks_of(pipeline, n, on_floats=on_floats)
    tracker.load(episodes[:n])
    names = ("x", "P", "error", "nees", "memory.accepted", "memory.mode")
    ours = tracker.run(*names, actions=actions)
    theirs = track(pipeline, episodes[:n], actions.T, T, names)
    np.testing.assert_array_equal(ours["memory.mode"], actions)
    for name in names:
        expected = theirs[name].swapaxes(0, 1)
        np.testing.assert_allclose(ours[name], expected, rtol=tolerance, atol=tolerance)
