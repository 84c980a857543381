"""Tests of replays, which run finished episodes again and smooth them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.smoothing import smoothed_again
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.world.episode import EpisodeBatch
from tests.engines.test_per_mode import BANK
from tests.filters.tracks import STREET, simulated, track
from tests.paths import representative

N = 11
T = 60
ACTIONS = np.random.default_rng(0).integers(0, 2, (N, T)).astype(np.uint8)
FAVORED = np.random.default_rng(3).integers(0, 3, (N, T)).astype(np.uint8)  # 0 favors no mode


def flat(episodes):
    return [e.on_flat_ground(float(e.truth_position_m[0, 2])) for e in episodes]


@pytest.mark.parametrize("planar", representative([False, True], False))
@pytest.mark.parametrize("bank", [None, BANK], ids=["shared beliefs", "per-mode beliefs"])
def test_a_replay_repeats_the_results_of_the_engine(planar, bank):
    episodes = flat(simulated(N, epochs=T)) if planar else simulated(N, epochs=T)
    pipeline = Pipeline(bank.modes if bank else default_modes(), STREET, planar)
    actions = FAVORED if bank else ACTIONS
    played = track(pipeline, episodes, actions.T, T, ("error", "nees"), bank=bank)
    error, nees, smoothed, _ = smoothed_again(pipeline, bank, EpisodeBatch.of(episodes), actions)
    assert_allclose(error, played["error"].swapaxes(0, 1), rtol=1e-9, atol=1e-9)
    assert_allclose(nees, played["nees"].swapaxes(0, 1), rtol=1e-9, atol=1e-9)
    assert_array_equal(smoothed[:, -1], error[:, -1])
    away = [np.linalg.norm(e, axis=-1)[:, 10:].mean() for e in (smoothed, error)]
    assert away[0] < 0.9 * away[1]


@pytest.mark.slow
def test_two_equal_modes_with_their_own_beliefs_are_smoothed_as_a_single_filter():
    """Check that the smoothed track equals a single filter's track, whichever mode is favored."""
    mode = Mode("a", "ukf", sigma_v=1.2)
    episodes = simulated(N, epochs=T)
    twins = Bank((mode, replace(mode, name="b")))
    pipeline = Pipeline(twins.modes, STREET)
    batch = EpisodeBatch.of(episodes)
    _, _, smoothed, _ = smoothed_again(pipeline, twins, batch, FAVORED)
    alone = Pipeline((mode,), STREET)
    _, _, expected, _ = smoothed_again(alone, None, batch, np.zeros((N, T), int))
    assert_allclose(smoothed, expected, rtol=1e-7, atol=1e-7)


def test_an_episode_that_ends_early_is_smoothed_back_from_its_last_epoch():
    episodes = simulated(2, epochs=T)
    replay = partial(smoothed_again, Pipeline(default_modes(), STREET), None)
    whole, *_ = replay(EpisodeBatch.of(episodes), ACTIONS[:2])
    error, nees, smoothed, _ = replay(EpisodeBatch.of(episodes), ACTIONS[:2, :9])
    assert error.shape == smoothed.shape == (2, 9, 3) and nees.shape == (2, 9)
    assert_array_equal(error, whole[:, :9])
    assert_array_equal(smoothed[:, -1], error[:, -1])
