"""Batches of environments: some of them start, go on or are run again."""

import numpy as np
import pytest

from mmwave_env.engines.env_engine import Engine
from mmwave_env.reward import TrackingReward
from tests.filters.tracks import pipeline_of, simulated

N, T = 11, 12
ON = pytest.mark.parametrize("on_floats", [False, True], ids=["lanes", "floats"])


def engine_of(episodes, on_floats=False):
    n = len(episodes)
    pipeline = pipeline_of(episodes[0].layout, ("ekf",))
    engine = Engine(pipeline, n, TrackingReward(), on_floats=on_floats)
    engine.reset(episodes)
    return engine


def everything(engine):
    return np.array([engine.column(i) for i in range(engine.read(engine.at.reward).size)])


@ON
def test_starting_some_leaves_the_others_as_they_are(on_floats):
    episodes, others = simulated(N, epochs=T), simulated(3, epochs=T + 5)
    engine = engine_of(episodes, on_floats)
    for _ in range(4):
        engine.step(np.int64(0))
    before, places = everything(engine), np.array([1, 6, 10])
    engine.batch.load(others, places)
    engine.start(places)
    expected = engine_of(others, on_floats)
    rest = np.setdiff1d(np.arange(N), places)
    np.testing.assert_array_equal(everything(engine)[rest], before[rest])
    for _ in range(3):
        observations = engine.observations()
        np.testing.assert_array_equal(observations[places], expected.observations())
        for one in (engine, expected):
            one.step(np.int64(0))


@ON
def test_loading_alone_starts_at_the_next_step(on_floats):
    episodes, others = simulated(N, epochs=T), simulated(2, epochs=T)
    engine, places = engine_of(episodes, on_floats), np.array([0, 9])
    engine.step(np.int64(0))
    engine.batch.load(others, places)
    engine.step(np.int64(0))
    np.testing.assert_array_equal(
        engine.observations()[places], engine_of(others, on_floats).observations()
    )
    truth = np.array([[*e.truth_position_m[0], *e.truth_velocity_mps[0]] for e in others])
    np.testing.assert_array_equal(engine.read(engine.at.truth)[places], truth)


@ON
def test_past_the_end_of_an_episode_epochs_are_blank(on_floats):
    long, short = simulated(1, epochs=T)[0], simulated(1, epochs=3)[0]
    together, alone = engine_of([long, short], on_floats), engine_of([short], on_floats)
    for _ in range(5):
        together.step(np.int64(0))
        alone.step(np.int64(0))
        np.testing.assert_array_equal(together.column(1), alone.column(0))
    assert alone.read(alone.at.pending.visible).max() == 0.0
