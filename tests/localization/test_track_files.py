"""Tracks as files, and truth by time."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.localization.track_files import Truth, table_beside, track_files
from mmwave_env.localization.tum import read_tum, tum_lines
from mmwave_env.models.measurement import Layout

NAMES = ["slow", 'fast, "wild"']


def some_track(epochs, seed=0):
    """A block of numbers that are a track's by shape alone."""
    rng = np.random.default_rng(seed)
    x = 100.0 * rng.standard_normal((epochs, 7))
    root = rng.standard_normal((epochs, 7, 7))
    rows, columns = np.tril_indices(7)
    P = (root @ np.swapaxes(root, 1, 2))[:, rows, columns]
    groups = rng.random((epochs, 4)) < 0.8
    return TrackBlock(
        layout=Layout(3), planar=False, time_s=1.7e9 + np.arange(epochs) / 3.0, x=x, P=P,
        P_predicted=P, smooth_x=x + 1.0, smooth_P=2.0 * P, mode=rng.integers(2, size=epochs),
        nis=rng.random((epochs, 4)), visible=groups, accepted=groups, incomplete=~groups,
        segment=0, skipped=0, dropped=0, share=1.0,
    )  # fmt: skip


def test_a_track_is_written_in_blocks_as_tum_and_as_a_table(tmp_path):
    blocks = [some_track(5), replace(some_track(4, 1), time_s=1.8e9 + np.arange(4.0))]
    out = tmp_path / "new" / "walk.v2.tum"
    with track_files(out, NAMES) as write:
        for block in blocks:
            write(block)
        assert not out.exists()
    assert sorted(path.name for path in out.parent.iterdir()) == ["walk.v2.csv", "walk.v2.tum"]
    time = np.concatenate([b.time_s for b in blocks])
    x, P = (np.concatenate([getattr(b, f) for b in blocks]) for f in ("smooth_x", "smooth_P"))
    written = read_tum(out)
    np.testing.assert_array_equal(written.time_s, time)
    np.testing.assert_array_equal(written.position_m, x[:, :3])
    with table_beside(out).open(newline="") as file:
        header, *rows = csv.reader(file)
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    assert columns.pop("mode") == tuple(NAMES[m] for b in blocks for m in b.mode)
    numbers = {name: np.array(values, float) for name, values in columns.items()}
    np.testing.assert_array_equal(numbers.pop("time_s"), time)
    diagonal = np.sqrt(P[:, [0, 2, 5, 9, 14, 20]])
    for i, name in enumerate(("x_m", "y_m", "z_m", "vx_mps", "vy_mps", "vz_mps")):
        np.testing.assert_allclose(numbers.pop(name), x[:, i], atol=1e-6)
        np.testing.assert_allclose(numbers.pop(f"sigma_{name}"), diagonal[:, i], rtol=1e-5)
    assert not numbers


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_track_cut_short_leaves_everything_as_it_was(tmp_path, error):
    out = tmp_path / "walk.tum"
    out.write_text("old")

    def write_some():
        with track_files(out, NAMES) as write:
            write(some_track(5))
            raise error

    with pytest.raises(error):
        write_some()
    assert out.read_text() == "old" and [path.name for path in tmp_path.iterdir()] == ["walk.tum"]


def test_the_table_is_not_the_track():
    assert table_beside(Path("a/walk")) == Path("a/walk.csv")
    with pytest.raises(ValueError, match="out: found walk.csv, expected a TUM file such as"):
        table_beside(Path("walk.csv"))


# --- truth


def truth_of(folder, time_s, position_m, monkeypatch, block_bytes=200):
    """Truth that is read a few poses at a time."""
    path = folder / "truth.tum"
    path.write_text(tum_lines(time_s, position_m))
    monkeypatch.setattr("mmwave_env.localization.lines._BLOCK_BYTES", block_bytes)
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
