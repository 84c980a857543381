"""Tests of batches: epochs after an episode ends, and metrics."""

import numpy as np
import pytest

from mmwave_env.engines.engine import Engine
from mmwave_env.engines.vector_step import Tally, count
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.metrics import INFO_KEYS, summary
from tests.filters.tracks import pipeline_of, simulated

T = 12


def engine_of(episodes, on_floats=False):
    pipeline = pipeline_of(episodes[0].layout, ("ekf",))
    engine = Engine(pipeline, len(episodes), TrackingReward(), on_floats=on_floats)
    engine.load(episodes)
    engine.step()
    return engine


@pytest.mark.parametrize("on_floats", [False, True], ids=["SIMD", "plain Python"])
def test_epochs_after_the_end_of_an_episode_are_blank(on_floats):
    long = simulated(1, epochs=T)[0]
    short = simulated(1, epochs=3)[0]
    together = engine_of([long, short], on_floats)
    alone = engine_of([short], on_floats)
    for _ in range(5):
        together.step(np.int64(0))
        alone.step(np.int64(0))
        np.testing.assert_array_equal(together.column(1), alone.column(0))
    assert alone.read(alone.at.pending.visible).max() == 0.0


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("dt", [1e-9, 0.1, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("epochs", [1, 5, 10, 11, 12, 25, 200])
def test_an_episode_ends_with_the_metrics_of_its_track(epochs, dt, axes, lost):
    """Check also an episode that has diverged because an error in its middle is NaN."""
    rng = np.random.default_rng(epochs)
    tally = Tally(3, axes)
    where = np.array([1])
    for _ in range(2):  # the first episode does not affect the second
        tally.begin(where, np.array([dt]), np.array([epochs]))
        errors = rng.normal(0.0, 20.0, (epochs, 3))
        nees = rng.chisquare(axes, epochs)
        if lost:
            errors[epochs // 2] = np.nan
        for k, (error, number) in enumerate(zip(errors, nees, strict=True)):
            count(tally.counts, 1, k, *error, number)
        metrics = tally.metrics(where, np.array([epochs]))
    expected = summary(errors, nees, max(1.0, round(1.0 / dt)), axes)
    assert {key: value.item() for key, value in metrics.items()} == pytest.approx(
        {key: float(expected[key]) for key in INFO_KEYS}, rel=1e-12, nan_ok=True
    )
    assert not tally.counts.sums[[0, 2]].any()
    assert tally.counts.errors.shape[1] <= epochs  # no longer than the episode, if < 1 s
