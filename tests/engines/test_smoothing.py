"""Tests of the smoothers of a mode and of interacting modes.

They are compared with filterpy on a linear model, with the textbook on our tracks, and with the
truth.
"""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.engines.smoothing import SMOOTHED, smooth
from mmwave_env.filters import Pipeline, textbook
from mmwave_env.filters.bank import Bank, modes_from
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.metrics import BURN_IN, nees_interval
from mmwave_env.task import task_from
from mmwave_env.world.episode import EpisodeBatch, columns_of
from mmwave_env.world.keys import keys_of
from tests.filters.tracks import nees_of, packed, pipeline_of, street_source, unpacked
from tests.paths import representative

TOLERANCE = 1e-9
TUNING = 5_000_000  # episode key of the first episode
HZ_PER_MPS = 93.4


@pytest.mark.parametrize("dt", [0.1, 1.0, 3.0])
def test_smoothing_a_linear_model_equals_filterpy(dt):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 7))
    kf = KalmanFilter(7, 4)
    kf.F = textbook.F(dt)
    kf.Q = dt * (0.1 * root @ root.T + 0.05 * np.eye(7))
    kf.H = rng.normal(size=(4, 7))
    kf.R = np.diag([0.5, 1.0, 2.0, 4.0])
    kf.x = rng.normal(size=(7, 1))
    kf.P = 10.0 * np.eye(7)
    x, P, x_predicted, P_predicted = kf.batch_filter(rng.normal(0.0, 5.0, (60, 4, 1)))
    expected_x, expected_P, *_ = kf.rts_smoother(x, P)
    filtered = x[None, ..., 0], packed(P)[None]
    predicted = x_predicted[None, ..., 0], packed(P_predicted)[None]
    tracks = np.concatenate([*filtered, *predicted], axis=2)
    steps = np.full((1, 60), dt)
    found_x, found_P = smooth(pipeline_of(), tracks, steps, HZ_PER_MPS)
    assert_allclose(found_x[0], expected_x[..., 0], rtol=TOLERANCE, atol=TOLERANCE)
    assert_allclose(unpacked(found_P[0]), expected_P, rtol=TOLERANCE, atol=TOLERANCE)
    first = smooth(pipeline_of(), tracks[:, :1], steps[:, :1], HZ_PER_MPS)
    for ours, part in zip(first, filtered, strict=True):
        assert_array_equal(ours, part[:, :1])  # a single epoch is not changed


def smoothed_modes(bank, batch, hz_per_mps, planar=False):
    """Return parts of an IMM's tracks by name, and the smoothed tracks (x, P)."""
    track = run_imm(bank, None, batch, "x", "mixture", planar=planar)
    pipeline = Pipeline(bank.modes, batch.layout, planar)
    at = columns_of(batch.layout)
    steps = batch.table[..., at.dt]
    spread = batch.table[..., at.doppler_spread_hz]
    return track, smooth_modes(bank, pipeline, track["mixture"], steps, spread, hz_per_mps)


@pytest.mark.parametrize("clock", ["synchronized", "offset", "free"])
@pytest.mark.parametrize("planar", representative([False, True], False))
def test_smoothed_tracks_equal_the_textbook(planar, clock):
    """Check the smoother, and the smoother for interacting modes with a single mode."""
    n = 9  # more than a block of eight
    time_s = np.random.default_rng(0).uniform(0.1, 2.0, (n, 50)).cumsum(axis=1)
    source = street_source(radio="standard", epochs=50, clock=clock)
    episodes = source.episodes(keys_of(range(n)))
    batch = EpisodeBatch.of(
        [replace(e, time_s=times) for e, times in zip(episodes, time_s, strict=True)]
    )
    hz_per_mps = source.scene.hz_per_mps
    bank = Bank(modes_from(["ukf"], "standard"))
    pipeline = Pipeline(bank.modes, source.layout, planar)
    engine = Engine(pipeline, n, observation="")
    engine.load(batch)
    x, P, P_predicted, tracks = engine.run("x", "P", "P_predicted", SMOOTHED).values()
    free = [0, 1, 3, 4, 6] if planar else list(range(7))
    if clock != "synchronized":
        free.append(7)
    drive = hz_per_mps if clock == "offset" else None
    smoothed = smooth(pipeline, tracks, np.diff(time_s, prepend=time_s[:, :1]), hz_per_mps)
    _, by_modes = smoothed_modes(bank, batch, hz_per_mps, planar)
    for e, times in enumerate(time_s):
        expected_x, expected_P = textbook.rts(
            x[e], unpacked(P[e]), unpacked(P_predicted[e]), times, free, drive
        )
        for smoothed_x, smoothed_P in (smoothed, by_modes):
            assert_allclose(smoothed_x[e], expected_x, rtol=1e-9, atol=1e-9)
            assert_allclose(unpacked(smoothed_P[e]), expected_P, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("radio", ["handset", "standard"])
def test_smoothed_modes_are_consistent_and_nearer_to_the_truth(radio):
    task = task_from(beliefs="per-mode", radio=radio)
    batch = task.simulated.sample_batch(np.arange(TUNING, TUNING + 40).astype(np.uint64))
    truth = batch.table[..., columns_of(batch.layout).truth[:3]]

    def error(x):
        return (x[..., :3] - truth)[:, BURN_IN:]

    track, (x, P) = smoothed_modes(task.bank, batch, task.simulated.scene.hz_per_mps)
    low, high = nees_interval()
    nees = nees_of(error(x), P[:, BURN_IN:])
    assert ((nees >= low) & (nees <= high)).mean() >= 0.90
    assert abs(nees.mean() - 3.0) < 1.0
    filtered = np.linalg.norm(error(track["x"]), axis=-1)
    assert np.linalg.norm(error(x), axis=-1).mean() < 0.8 * filtered.mean()
