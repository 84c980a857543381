"""Tests of logs with a free clock, and of logs of time differences."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from mmwave_env.datasets.log_folder import LOG, SCENE, TRUTH
from mmwave_env.filters.bank import modes_from
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import Scene, Streets
from policies.rules import by_predicted_speed
from tests.cli import command, succeed
from tests.filters.tracks import lasting
from tests.localization.mistakes import differences, wrong_log

ANCHORS = np.array([[0.2, 0.2, 2.6], [3.8, 0.4, 2.2], [3.7, 12.6, 2.7], [0.3, 12.8, 2.0]])
PLACES = np.array([[1, 2], [3, 2.5], [1, 6.5], [3, 7], [1, 11], [3, 10.5]])
STEP_M = 2.44  # one sample at 122.88 MHz
HEIGHT_M = 1.2
ROOM = Scene(
    "room",
    ANCHORS[0].tolist(),
    virtual_anchors_m=ANCHORS[1:].tolist(),
    streets=Streets((0.0, 4.0), (0.0, 13.0), 1.0, HEIGHT_M),
)


def room(folder, wild, seed):
    """Write a log as receivers of open stacks do; return the true positions by time.

    A user stands at six places in a room, 100 epochs per second. Ranges come in whole samples, and
    the clock jumps by kilometers in a third of the epochs. Errors last 0.3 s; ``wild`` is the share
    of ranges that are 20 to 300 m off. Return also a log without these.
    """
    rng = np.random.default_rng(seed)
    each = 800
    n = 6 * each
    place = np.arange(n) // each
    position = np.column_stack([PLACES[place], np.full(n, HEIGHT_M)])
    time_s = np.arange(n) * 0.01 + 5.0 * place
    exact = np.linalg.norm(ANCHORS - position[:, None], axis=2)
    far = np.zeros((n, 4))
    for anchor in range(4):
        t = 0
        while t < n:
            length = 1 + int(rng.exponential(30.0))
            if rng.random() < wild:
                far[t : t + length, anchor] = rng.uniform(20.0, 300.0) * rng.choice([1, 1, -1])
            t += length
    bias = rng.uniform(1.0, 2.0, 4) * rng.choice([-1, 1], 4)
    jumps = np.where(rng.random(n) < 1 / 3, rng.normal(0.0, 3000.0, n), np.nan)
    clock = pd.Series(jumps).ffill().fillna(0.0).to_numpy()
    measured = exact + 0.8 * lasting(rng, n, 4, np.exp(-0.01 / 0.3)) + bias + far + clock[:, None]
    rows = pd.DataFrame({
        "time_s": np.repeat(time_s, 4).round(3),
        "anchor": np.tile([1, 2, 3, 4], n),
        "range_m": (np.round(measured / STEP_M) * STEP_M).ravel(),
        "range_sigma_m": 1.5,
    })  # fmt: skip
    rows.to_csv(folder / "all.csv", index=False)
    rows[(far == 0.0).ravel()].to_csv(folder / "right.csv", index=False)
    return dict(zip(time_s.round(3), position, strict=True))


@pytest.mark.slow  # compiles a kernel for four anchors
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_clock_that_jumps_and_a_fifth_of_wild_ranges_cost_little(tmp_path, seed):
    """Compare with the same log without the wild ranges."""
    truth = room(tmp_path, 0.2, seed)
    modes = modes_from(["ekf", "ukf"], "handset")
    switching = Switching(modes, rule=by_predicted_speed)
    radio = replace(RADIOS["handset"], start_velocity_mps=1.0)
    medians = []
    for name in ("all.csv", "right.csv"):
        log = read_log(tmp_path / name, ROOM, snr_db=20.0, clock="free")
        track = localize(log, ROOM, radio, switching, None, HEIGHT_M, correlation_s=0.3)
        assert len(track) > 0.97 * len(log)
        true = np.array([truth[round(t, 3)] for t in track.time_s])
        away = np.linalg.norm(track.x[:, :2] - true[:, :2], axis=1)
        medians.append(np.median(away))
    assert medians[0] < 1.2 * medians[1]


@pytest.fixture(scope="module")
def ride(tmp_path_factory):
    """Return the folder of a simulated log with a free clock."""
    folder = tmp_path_factory.mktemp("ride") / "ride"
    words = ("--seed", 2, "--radio", "standard", "--clock", "free", "--dt", 0.5)
    succeed("simulate", *words, "--episode-steps", 60, "--out", folder)
    return folder


def test_time_differences_give_the_same_track_as_times_of_arrival(tmp_path, ride):
    wrong_log(tmp_path, ride, differences)
    (tmp_path / SCENE).write_text((ride / SCENE).read_text())
    tracks = []
    for folder in (ride, tmp_path):
        words = (folder / LOG, "--scene", folder / SCENE, "--speed", "auto", "--clock", "free")
        succeed("localize", *words, "--out", tmp_path / "track.csv")
        tracks.append(pd.read_csv(tmp_path / "track.csv"))
    positions = [track[["x_m", "y_m", "z_m", "sigma_x_m"]] for track in tracks]
    assert_allclose(*positions, atol=1e-5)
    truth = np.loadtxt(ride / TRUTH)
    away = np.linalg.norm(tracks[0][["x_m", "y_m"]] - truth[-len(tracks[0]) :, 1:3], axis=1)
    assert np.median(away) < 2.0


def test_time_differences_need_a_free_clock_and_should_have_a_reference(tmp_path, ride):
    path = wrong_log(tmp_path, ride, differences)
    scene = ("--scene", ride / SCENE, "--speed", "auto")
    done = command("localize", path, *scene)
    assert done.returncode == 2 and "expected the setting 'free'" in done.stderr
    log = pd.read_csv(path)
    log[log.rstd_s != 0.0].to_csv(path, index=False)
    done = command("localize", path, *scene, "--clock", "free")
    assert done.returncode == 0 and "epochs without a reference" in done.stderr
