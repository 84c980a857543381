"""Truth by time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.logs.truth import Truth
from mmwave_env.logs.tum import tum_lines


def truth_of(folder, time_s, position_m, monkeypatch, block_bytes=200):
    """Truth that is read a few poses at a time."""
    path = folder / "truth.tum"
    path.write_text(tum_lines(time_s, position_m))
    monkeypatch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", block_bytes)
    return Truth(path)


times = st.lists(st.integers(0, 4000), min_size=1, max_size=60, unique=True)


@settings(max_examples=60, deadline=None)
@given(poses=times, epochs=times, size=st.integers(1, 20))
def test_the_nearest_pose_is_found_whatever_the_blocks(tmp_path_factory, poses, epochs, size):
    pose_s, time_s = np.sort(poses) * 1e-3, np.sort(epochs) * 1e-3 + 1e-4
    position = np.random.default_rng(0).standard_normal((len(pose_s), 3))
    with pytest.MonkeyPatch.context() as patch:
        truth = truth_of(tmp_path_factory.mktemp("truth"), pose_s, position, patch)
        found = np.concatenate(
            [truth.at(time_s[i : i + size], 0.01) for i in range(0, len(time_s), size)]
        )
        truth.read_on()
    away = np.abs(time_s[:, None] - pose_s)
    nearest = np.where(
        away.min(axis=1, keepdims=True) <= 0.01, position[away.argmin(axis=1)], np.nan
    )
    np.testing.assert_array_equal(found, nearest)
    assert (truth.first_s, truth.last_s) == (pose_s[0], pose_s[-1])


def test_poses_are_matched_as_by_evo(tmp_path, monkeypatch):
    sync = pytest.importorskip("evo.core.sync")
    rng = np.random.default_rng(1)
    pose_s = np.arange(0.0, 30.0, 0.05) + rng.uniform(-0.02, 0.02, 600)
    time_s = np.arange(5.0, 40.0, 0.2) + rng.uniform(-0.02, 0.02, 175)
    position = rng.standard_normal((600, 3))
    found = truth_of(tmp_path, pose_s, position, monkeypatch).at(time_s)
    ours, theirs = sync.matching_time_indices(time_s, pose_s)
    expected = np.full((175, 3), np.nan)
    expected[ours] = position[theirs]
    np.testing.assert_array_equal(found, expected)
    assert 20 < len(ours) < 125


def test_a_damaged_truth_is_named(tmp_path, monkeypatch):
    truth = truth_of(tmp_path, np.arange(90.0), np.zeros((90, 3)), monkeypatch)
    truth.path.write_text(truth.path.read_text().replace("\n50.0 ", "\nx "))
    truth = Truth(truth.path)
    assert np.isfinite(truth.at(np.arange(20.0))).all()
    with pytest.raises(ValueError, match=r"truth.tum, line 51, t: found 'x'"):
        truth.at(np.arange(20.0, 60.0))
