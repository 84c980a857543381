"""Tests of times and velocities, from trajectory.csv (the "sidecar" that users add) or dt_s."""

import numpy as np
import pytest

from mmwave_env.datasets.deepmimo import read_deepmimo
from tests.datasets.deepmimo.scenarios import TRUTH, edit, load, shortened
from tests.refusals import refuses


@pytest.fixture
def folder(tmp_path):
    return shortened(tmp_path / "walk", 30)


def test_without_a_sidecar_times_follow_from_dt_s_and_velocities_are_differences(folder):
    expected = read_deepmimo(folder)
    (folder / TRUTH).unlink()
    recording = read_deepmimo(folder, dt_s=0.1)
    np.testing.assert_allclose(recording.time_s, expected.time_s, atol=1e-9)
    np.testing.assert_array_equal(recording.position_m, load(folder, "rx_pos"))
    np.testing.assert_allclose(recording.velocity_mps, expected.velocity_mps, atol=0.06)
    shifts_hz = recording.measurement[:, -1], expected.measurement[:, -1]
    np.testing.assert_allclose(*shifts_hz, atol=5.0)


@pytest.mark.parametrize("dt_s", [0.0, float("nan")])
def test_an_impossible_time_between_epochs_is_refused(folder, dt_s):
    with refuses("dt_s"):
        read_deepmimo(folder, dt_s=dt_s)


def test_missing_velocities_are_computed_from_positions(folder):
    expected = read_deepmimo(folder)
    lines = (folder / TRUTH).read_text().splitlines()
    (folder / TRUTH).write_text("\n".join(",".join(line.split(",")[:4]) for line in lines))
    recording = read_deepmimo(folder)
    np.testing.assert_array_equal(recording.measurement[:, :12], expected.measurement[:, :12])
    np.testing.assert_allclose(recording.velocity_mps, expected.velocity_mps, atol=0.06)


def changed(folder, change):
    """Write the sidecar again after ``change`` has changed its table (epochs, 7) in place."""
    rows = np.loadtxt(folder / TRUTH, delimiter=",", skiprows=1)
    change(rows)
    lines = [",".join(f"{value:.6f}" for value in row) for row in rows]
    (folder / TRUTH).write_text("\n".join(["t,x,y,z,vx,vy,vz", *lines]))


def scaled(columns, factor):
    return lambda folder: changed(folder, lambda rows: np.multiply.at(rows.T, columns, factor))


def jump(folder):
    changed(folder, lambda rows: np.add.at(rows, np.s_[10:, 1], 21.0))


def receivers_jump(folder):
    edit(folder, "rx_pos", lambda a: np.where(np.arange(30)[:, None] < 9, a, a + 50.0))


def nothing(folder):
    pass


SPOILT = {  # name -> (function that damages a folder, reader's arguments, place in the refusal)
    "a jump": (jump, {}, "line 12: speed"),
    "a jump of the receivers": (receivers_jump, {"dt_s": 0.1}, "row 10: speed"),
    "a time in milliseconds": (scaled([0], 1e3), {}, "line 3: t"),
    "a time step in milliseconds": (nothing, {"dt_s": 100.0}, "row 2: t"),
    "velocities in km/h": (scaled([4, 5, 6], 3.6), {}, "vx, vy, vz"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_impossible_times_and_velocities_are_refused(folder, name):
    spoil, arguments, place = SPOILT[name]
    spoil(folder)
    with refuses(folder, place):
        read_deepmimo(folder, **arguments)
