"""Tests of scores and statistics of a track."""

from dataclasses import replace

import numpy as np
import pytest

from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.localization.position_errors import horizontal_level
from mmwave_env.localization.track_scores import (
    group_statistics,
    track_statistics,
    truth_scores,
    warn_if_far,
)
from mmwave_env.metrics import BURN_IN, summary
from tests.filters.tracks import nees_of, unpacked
from tests.localization.test_track_files import some_track
from tests.logs.test_tum import truth_of

T = 400
FEW = pytest.mark.filterwarnings("ignore:.*found a true position for")


@FEW
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("known", [slice(0, T), slice(70, 330), slice(10, 12), slice(10, 11)])
def test_scores_equal_the_metrics_of_complete_tracks(tmp_path, planar, known):
    block = replace(some_track(T), planar=planar)
    truth = block.x[:, :3] + np.random.default_rng(1).standard_normal((T, 3))
    known_truth = truth_of(tmp_path, block.time_s[known], truth[known])
    tracks = {"filtered": (block.x, block.P), "smoothed": (block.smooth_x, block.smooth_P)}
    figures = truth_scores(block, known_truth, list(tracks), risk=0.1)
    n = known.stop - known.start
    assert figures["scored"] == n
    axes = [i for i in range(3) if not (planar and i in VERTICAL)]
    for name, (x, P) in tracks.items():
        error = (x[:, :3] - truth)[known]
        row = figures["tracks"][name]
        nees = nees_of(error[:, axes], P[known])
        begin = np.zeros(BURN_IN)
        whole = np.concatenate([error[:1].repeat(BURN_IN, axis=0), error])
        metrics = summary(whole, np.append(begin, nees), 3, len(axes))
        for key in ("ate_m", "rmse_m", "nees", "in_bounds"):
            assert row[key] == pytest.approx(metrics[key], rel=1e-6)
        across = np.hypot(error[:, 0], error[:, 1])
        levels = horizontal_level(P[known], figures["risk"])
        assert row["horizontal"]["percentiles_m"]["67"] == np.quantile(across, 0.67)
        assert row["horizontal"]["exceeded"] == (across > levels).sum()
        assert ("vertical" in row) is not planar
        if n > 3:
            assert figures["rpe_s"] == pytest.approx(1.0, abs=1e-6)  # three steps of 1/3 s
            assert row["rpe_m"] == pytest.approx(metrics["rpe_m"], rel=1e-9)
        else:
            assert row["rpe_m"] is None
    assert figures["nees_expected"] == len(axes)


def test_only_a_ground_truth_in_another_frame_causes_a_warning(tmp_path, recwarn):
    block = some_track(T)
    for x, y in ((0, 1), (1, 0)):
        truth = truth_of(tmp_path, block.time_s, block.x[:, [x, y, 2]] + 0.01)
        scores = truth_scores(block, truth, ["filtered"])
        assert not recwarn
        warn_if_far(truth, scores)
    (warning,) = recwarn
    assert "truth.tum: found a mean NEES" in str(warning.message)


def scored_at(tmp_path, time_s, known, second_segment=T):
    """Return RPE, time between paired epochs, and positions; the known true positions are zero."""
    segment = (np.arange(T) >= second_segment).astype(int)
    block = replace(some_track(len(time_s)), time_s=time_s, segment=segment)
    truth = truth_of(tmp_path, time_s[known], np.zeros((len(known), 3)))
    figures = truth_scores(block, truth, ["filtered"])
    return figures["tracks"]["filtered"]["rpe_m"], figures["rpe_s"], block.x[:, :3]


def assert_rpe(scored, pairs, apart):
    """Assert that the RPE is the mean distance between the positions of pairs of epochs."""
    rpe_m, rpe_s, x = scored
    lengths = [np.linalg.norm(x[second] - x[first]) for first, second in pairs]
    assert rpe_m == pytest.approx(np.mean(lengths), rel=1e-9)
    assert rpe_s == pytest.approx(apart)


def test_rpe_pairs_epochs_one_second_apart_but_not_across_gaps(tmp_path):
    time = 0.1 * np.arange(T) + np.where(np.arange(T) >= 130, 7.3, 0.0)
    known = np.array([k for k in range(T) if not 200 <= k < 255])
    pairs = [(k, k + 10) for k in known if k + 10 in known and not k < 130 <= k + 10]
    assert_rpe(scored_at(tmp_path, time, known), pairs, 1.0)


@FEW
def test_a_ground_truth_with_several_seconds_between_poses_gives_no_rpe(tmp_path):
    rpe_m, apart, _ = scored_at(tmp_path, 0.1 * np.arange(T), np.arange(0, T, 100))
    assert rpe_m is None and apart is None


@pytest.mark.parametrize("step", [1.0, 3.0])
def test_rpe_of_slow_logs_pairs_only_neighboring_epochs_of_a_segment(tmp_path, step):
    time = step * np.arange(T)
    time[50:] += 9.0 * step
    known = np.array([k for k in range(T) if k != 70])
    pairs = [(k, k + 1) for k in range(T - 1) if k not in (49, 69, 70, 99)]
    assert_rpe(scored_at(tmp_path, time, known, second_segment=100), pairs, step)


KEYS = ["seen", "rejected", "rejected_share", "incomplete", "nis_per_dof", "nis_in_bounds"]
GROUPS = {  # a link has 4 degrees of freedom, and its NIS is in bounds from 0.48 to 11.1
    "anchor 1": [3, 1, 1 / 3, 1, 1.0, 1.0],
    "anchor 2": [3, 0, 0.0, 1, 2.0, 1.0],
    "anchor 3": [0, 0, None, 4, None, None],
    "Doppler": [4, 0, 0.0, 0, 9.0, 0.0],
    "all": [10, 1, 0.1, 6, (2 * 4.0 + 3 * 8.0 + 4 * 9.0) / (2 * 4 + 3 * 4 + 4), 5 / 9],
}


def test_statistics_of_groups_equal_those_computed_by_hand():
    visible = np.array([[1, 1, 0, 1], [1, 1, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1]], bool)
    accepted = visible.copy()
    accepted[1, 0] = False
    nis = visible * [4.0, 8.0, 0.0, 9.0]
    track = some_track(4)
    track = replace(track, visible=visible, incomplete=~visible, accepted=accepted, nis=nis)
    figures = group_statistics(track, track.accepted, track.nis)
    assert figures == {name: dict(zip(KEYS, row, strict=True)) for name, row in GROUPS.items()}


def test_the_statistics_of_a_track_equal_those_of_its_arrays():
    segment = np.repeat([0, 2], [1, T - 1])
    block = replace(some_track(T), skipped=5, segment=segment, dropped=7, modes=["slow", "fast"])
    figures = track_statistics(block)
    speed = np.linalg.norm(block.x[:, 3:6], axis=1)
    expected = {
        "epochs": T, "skipped": 5, "restarts": 2, "dropped": 7,
        "first_s": block.time_s[0], "last_s": block.time_s[-1],
        "modes": {"slow": (block.mode == 0).sum(), "fast": (block.mode == 1).sum()},
        "switches": (np.diff(block.mode) != 0).sum(),
    }  # fmt: skip
    assert figures | expected == figures
    above = (speed > 20.0).sum()
    speeds = {"mean": speed.mean(), "max": speed.max(), "epochs_above_design_limit": above}
    assert figures["speed_mps"] == pytest.approx(speeds)
    xx, yy, zz = (unpacked(block.smooth_P)[:, i, i].mean() for i in range(3))
    rmse_m = {"horizontal": np.sqrt(xx + yy), "vertical": np.sqrt(zz)}
    assert figures["expected_rmse_m"] == pytest.approx(rmse_m, rel=1e-12)
