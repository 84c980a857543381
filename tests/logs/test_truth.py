"""Truth by time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from mmwave_env.logs.truth import BRIDGED_S, TOLERANCE_S, Truth
from mmwave_env.logs.tum import tum_lines


def truth_of(folder, time_s, position_m, monkeypatch, block_bytes=200):
    """Truth that is read a few poses at a time."""
    path = folder / "truth.tum"
    path.write_text(tum_lines(time_s, position_m))
    monkeypatch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", block_bytes)
    return Truth(path)


def expected(pose_s, position, time_s):
    """Run by run between gaps, by SciPy's cubics and NumPy's gradients."""
    p, v = np.full((2, len(time_s), 3), np.nan)
    runs = np.split(np.arange(len(pose_s)), np.flatnonzero(np.diff(pose_s) > BRIDGED_S) + 1)
    for run in runs:
        t, x = pose_s[run], position[run]
        away = np.abs(time_s[:, None] - t)
        near = away.min(axis=1) <= TOLERANCE_S
        p[near] = x[away[near].argmin(axis=1)]
        if len(run) > 1:
            way = CubicHermiteSpline(t, x, np.gradient(x, t, axis=0))
            inside = (time_s >= t[0]) & (time_s <= t[-1])
            p[inside], v[inside] = way(time_s[inside]), way(time_s[inside], 1)
    return p, v


times = st.lists(st.integers(0, 4000), min_size=1, max_size=60, unique=True)


@settings(max_examples=80, deadline=None)
@given(poses=times, epochs=times, size=st.integers(1, 20), late=st.sampled_from([0.0, 1e-3]))
def test_poses_are_interpolated_between_gaps_whatever_the_blocks(
    tmp_path_factory, poses, epochs, size, late
):
    pose_s, time_s = np.sort(poses) * 1e-2, np.sort(epochs) * 1e-2 + late
    position = np.random.default_rng(0).standard_normal((len(pose_s), 3))
    with pytest.MonkeyPatch.context() as patch:
        truth = truth_of(tmp_path_factory.mktemp("truth"), pose_s, position, patch)
        parts = [truth.at(time_s[i : i + size]) for i in range(0, len(time_s), size)]
        truth.read_on()
    found, velocity, away = map(np.concatenate, zip(*parts, strict=True))
    p, v = expected(pose_s, position, time_s)
    np.testing.assert_allclose(found, p, atol=1e-9)
    np.testing.assert_allclose(velocity, v, atol=1e-6)
    apart = pose_s - time_s[:, None]
    np.testing.assert_array_equal(
        np.abs(away), np.where(np.isnan(p[:, 0]), np.nan, np.abs(apart).min(axis=1))
    )
    assert (truth.first_s, truth.last_s) == (pose_s[0], pose_s[-1])


def test_a_pose_at_the_time_of_an_epoch_is_taken_to_the_last_bit(tmp_path, monkeypatch):
    rng = np.random.default_rng(1)
    pose_s = np.cumsum(rng.uniform(0.01, 2.0, 300))
    position = 1e3 * rng.standard_normal((300, 3))
    found = truth_of(tmp_path, pose_s, position, monkeypatch).at(pose_s)
    np.testing.assert_array_equal(found.position_m, position)
    np.testing.assert_array_equal(found.away_s, 0.0)


@pytest.mark.parametrize("rate_hz", [1.0, 3.0, 30.0, 100.0])
def test_who_accelerates_is_where_he_was_at_any_rate(tmp_path, monkeypatch, rate_hz):
    def way(t):
        return np.column_stack([3.0 * t + 0.8 * t**2, -2.0 * t, np.full(len(t), 1.5)])

    pose_s, time_s = np.arange(0.0, 20.0, 1.0 / rate_hz) + 0.0123, np.arange(2.0, 15.0, 0.1)
    found = truth_of(tmp_path, pose_s, way(pose_s), monkeypatch).at(time_s)
    np.testing.assert_allclose(found.position_m, way(time_s), atol=1e-9)
    np.testing.assert_allclose(found.velocity_mps[:, 0], 3.0 + 1.6 * time_s, atol=1e-9)


def test_the_poses_that_evo_matches_are_near(tmp_path, monkeypatch):
    sync = pytest.importorskip("evo.core.sync")
    rng = np.random.default_rng(1)
    pose_s = np.arange(0.0, 30.0, 0.05) + rng.uniform(-0.02, 0.02, 600)
    time_s = np.arange(5.0, 40.0, 0.2) + rng.uniform(-0.02, 0.02, 175)
    found = truth_of(tmp_path, pose_s, rng.standard_normal((600, 3)), monkeypatch).at(time_s)
    ours, theirs = sync.matching_time_indices(time_s, pose_s)
    np.testing.assert_allclose(found.away_s[ours], pose_s[theirs] - time_s[ours], atol=1e-12)
    others = np.setdiff1d(np.flatnonzero(np.isfinite(found.away_s)), ours)
    assert 20 < len(ours) < 125 and (np.abs(found.away_s[others]) > TOLERANCE_S).all()


def test_no_more_of_a_long_truth_is_held_than_is_needed(tmp_path, monkeypatch):
    pose_s = np.arange(0.0, 900.0, 0.01)
    truth = truth_of(tmp_path, pose_s, np.zeros((len(pose_s), 3)), monkeypatch, 20_000)
    read, held = truth._read, []

    def watched(first_s):
        read(first_s)
        held.append(len(truth._near.time_s))

    monkeypatch.setattr(truth, "_read", watched)
    truth.at(np.arange(0.0, 890.0, 1.0))
    assert max(held) < 3000 and len(held) > 90


def test_a_damaged_truth_is_named(tmp_path, monkeypatch):
    truth = truth_of(tmp_path, np.arange(90.0), np.zeros((90, 3)), monkeypatch)
    truth.path.write_text(truth.path.read_text().replace("\n50.0 ", "\nx "))
    truth = Truth(truth.path)
    assert np.isfinite(truth.at(np.arange(20.0)).position_m).all()
    with pytest.raises(ValueError, match=r"truth.tum, line 51, t: found 'x'"):
        truth.at(np.arange(20.0, 60.0))
