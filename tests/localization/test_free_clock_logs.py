"""Tests of logs with a free clock, and of logs of time differences."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from mmwave_env.datasets.log_folder import LOG, SCENE, TRUTH
from tests.cli import command, succeed


@pytest.fixture(scope="module")
def ride(tmp_path_factory):
    """Return the folder of a simulated log with a free clock."""
    folder = tmp_path_factory.mktemp("ride") / "ride"
    words = ("--seed", 2, "--radio", "standard", "--clock", "free", "--episode-steps", 60)
    succeed("simulate", *words, "--out", folder)
    return folder


def words_of(folder):
    return folder / LOG, "--scene", folder / SCENE, "--speed", "auto", "--clock", "free"


def test_time_differences_give_the_same_track_as_times_of_arrival(tmp_path, ride):
    log = pd.read_csv(ride / LOG)
    first = log.groupby("time_s").toa_s.transform("first")
    log["toa_s"] = log.toa_s - first
    log = log.rename(columns={"toa_s": "rstd_s"})
    (tmp_path / SCENE).write_text((ride / SCENE).read_text())
    log.to_csv(tmp_path / LOG, index=False)
    tracks = []
    for folder in (ride, tmp_path):
        succeed("localize", *words_of(folder), "--out", tmp_path / "track.csv")
        tracks.append(pd.read_csv(tmp_path / "track.csv"))
    positions = [track[["x_m", "y_m", "z_m", "sigma_x_m"]] for track in tracks]
    assert_allclose(*positions, atol=1e-5)
    truth = np.loadtxt(ride / TRUTH)
    away = np.linalg.norm(tracks[0][["x_m", "y_m"]] - truth[-len(tracks[0]) :, 1:3], axis=1)
    assert np.median(away) < 2.0


def test_time_differences_need_a_free_clock_and_should_have_a_reference(tmp_path, ride):
    log = pd.read_csv(ride / LOG).rename(columns={"toa_s": "rstd_s"})
    log["rstd_s"] -= log.groupby("time_s").rstd_s.transform("first")
    log.to_csv(tmp_path / LOG, index=False)
    scene = ("--scene", ride / SCENE, "--speed", "auto")
    done = command("localize", tmp_path / LOG, *scene)
    assert done.returncode == 2 and "expected the setting 'free'" in done.stderr
    lonely = log[log.rstd_s != 0.0]
    lonely.to_csv(tmp_path / LOG, index=False)
    done = command("localize", tmp_path / LOG, *scene, "--clock", "free")
    assert done.returncode == 0 and "epochs without a reference" in done.stderr


def test_an_epoch_with_one_range_determines_no_start(tmp_path, ride):
    log = pd.read_csv(ride / LOG)[["time_s", "anchor", "toa_s", "snr_db"]]
    log[log.anchor == 1].to_csv(tmp_path / LOG, index=False)
    done = command("localize", tmp_path / LOG, "--scene", ride / SCENE, "--clock", "free")
    assert done.returncode == 2 and "none of which determines a position" in done.stderr
