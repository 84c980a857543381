"""Whole tracks equal the epochs of the engine, whatever runs them."""

from dataclasses import replace

import numpy as np
import pytest

from mmwave_env.engines.track_engine import Tracker
from mmwave_env.filters.mode_files import default_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.numerics.numbers import sqrt, where
from tests.filters.tracks import STREET, simulated, track

N, T = 11, 60


def faster_than_2(x, epoch):
    return where(sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5]) > 2.0, 1.0, 0.0)


def part(episode, first, last):
    cut = slice(first, last)
    names = ("time_s", "measurement", "sigma", "visible", "snr_db", "doppler_spread_hz",
             "truth_position_m", "truth_velocity_mps")  # fmt: skip
    return replace(episode, **{name: getattr(episode, name)[cut] for name in names})


@pytest.fixture(scope="module")
def episodes():
    return simulated(N, epochs=T)


@pytest.mark.parametrize("mode", [*default_modes(), Mode("plain", "ekf", coupling=False)])
def test_a_track_is_the_engines(mode, episodes):
    pipeline = Pipeline((mode,), STREET)
    tracker = Tracker(pipeline, N)
    tracker.load(episodes)
    names = ("x", "P", "error", "nees", "memory.accepted")
    ours = tracker.run(*names)
    theirs = track(pipeline, episodes, 0, T, names)
    for name in names:
        np.testing.assert_allclose(ours[name], theirs[name].swapaxes(0, 1), rtol=1e-12, atol=1e-12)


def test_a_rule_picks_the_mode_by_what_was_known_before_the_epoch(episodes):
    pipeline = Pipeline(default_modes(), STREET)
    tracker = Tracker(pipeline, N, faster_than_2)
    tracker.load(episodes)
    ours = tracker.run("x", "memory.mode")
    before = np.concatenate(
        [np.stack([e.prior_mean for e in episodes])[:, None], ours["x"][:, :-1]], axis=1
    )
    picked = np.linalg.norm(before[..., 3:6], axis=-1) > 2.0
    np.testing.assert_array_equal(ours["memory.mode"], picked)
    assert 0.1 < picked.mean() < 0.9
    theirs = track(pipeline, episodes, picked.T.astype(np.int64), T, ("x",))
    np.testing.assert_allclose(ours["x"], theirs["x"].swapaxes(0, 1), rtol=1e-11, atol=1e-11)


def test_a_tuning_is_data(episodes):
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


def test_a_track_goes_on_where_it_ended(episodes):
    whole = Tracker(Pipeline(default_modes(), STREET), N, faster_than_2)
    whole.load(episodes)
    expected = whole.run("x", "P_predicted", "memory.gamma")
    pieces = Tracker(Pipeline(default_modes(), STREET), N, faster_than_2)
    found = []
    for first, last in ((0, 1), (1, 25), (25, T)):
        pieces.load([part(episode, first, last) for episode in episodes], go_on=first > 0)
        found.append(pieces.run("x", "P_predicted", "memory.gamma"))
    for name, values in expected.items():
        joined = np.concatenate([piece[name] for piece in found], axis=1)
        np.testing.assert_array_equal(joined, values)


@pytest.mark.parametrize("on_floats", [False, True])
def test_actions_pick_the_mode(on_floats, episodes):
    pipeline = Pipeline(default_modes(), STREET)
    actions = np.random.default_rng(0).integers(0, 2, (3, T))
    tracker = Tracker(pipeline, 3, on_floats=on_floats)
    tracker.load(episodes[:3])
    found = tracker.run("x", "memory.mode", actions=actions)
    np.testing.assert_array_equal(found["memory.mode"], actions)
    expected = track(pipeline, episodes[:3], actions.T, T, ("x",))["x"]
    np.testing.assert_allclose(found["x"], expected.swapaxes(0, 1), rtol=1e-11, atol=1e-11)


def test_two_modes_need_a_rule_or_actions(episodes):
    tracker = Tracker(Pipeline(default_modes(), STREET), N)
    tracker.load(episodes)
    with pytest.raises(ValueError, match="modes: found 2, no rule and no actions, expected one"):
        tracker.run("x")
