"""Tests of the smoother for interacting modes, against the single-mode smoother and the truth."""

import numpy as np
import pytest

from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.engines.smoothing import SMOOTHED, smooth
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.metrics import BURN_IN, nees_interval
from mmwave_env.task import task_from
from mmwave_env.world.episode import columns_of
from tests.filters.tracks import nees_of

TUNING = 5_000_000  # episode key of the first episode


def smoothed(task, bank, n):
    """Return n episodes, an IMM's tracks, their time steps (s) and smoothed (x, P)."""
    batch = task.simulated.sample_batch(np.arange(TUNING, TUNING + n).astype(np.uint64))
    pipeline = Pipeline(bank.modes, batch.layout, task.pipeline.planar)
    track = run_imm(bank, TrackingReward(), batch, "x", "P", "mixture", planar=pipeline.planar)
    at = columns_of(batch.layout)
    hz_per_mps = task.simulated.scene.hz_per_mps
    dt = batch.table[..., at.dt]
    spread = batch.table[..., at.doppler_spread_hz]
    return batch, track, dt, smooth_modes(bank, pipeline, track["mixture"], dt, spread, hz_per_mps)


def nees(batch, x, P):
    """Return the position error (n, T, 3) and its NEES (n, T), without the burn-in."""
    error = (x[..., :3] - batch.table[..., columns_of(batch.layout).truth[:3]])[:, BURN_IN:]
    return error, nees_of(error, P[:, BURN_IN:])


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("dt", [1.0, 0.1])
def test_smoothing_a_single_mode_equals_the_rts_smoother(planar, dt):
    task = task_from(dt=dt, planar=planar, episode_steps=40)
    modes = default_modes()[:1]
    batch, _, steps, (x, P) = smoothed(task, Bank(modes), 4)
    pipeline = Pipeline(modes, batch.layout, planar)
    engine = Engine(pipeline, 4, observation="")
    engine.load(batch)
    expected = smooth(
        pipeline, engine.run(SMOOTHED)[SMOOTHED], steps, task.simulated.scene.hz_per_mps
    )
    for ours, theirs in zip((x, P), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("radio", ["handset", "standard"])
def test_smoothed_modes_are_consistent_and_nearer_to_the_truth(radio):
    task = task_from(beliefs="per-mode", radio=radio)
    batch, track, _, smooth_belief = smoothed(task, task.bank, 40)
    low, high = nees_interval()
    error, values = nees(batch, *smooth_belief)
    filtered, _ = nees(batch, track["x"], track["P"])
    assert ((values >= low) & (values <= high)).mean() >= 0.90
    assert abs(values.mean() - 3.0) < 1.0
    assert np.linalg.norm(error, axis=-1).mean() < 0.8 * np.linalg.norm(filtered, axis=-1).mean()
