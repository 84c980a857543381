"""Tests of times and velocities, from dt_s or from the sidecar (the file trajectory.csv)."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.deepmimo import read_deepmimo
from tests.datasets.deepmimo.scenarios import TRUTH, edit, load, shortened
from tests.refusals import refuses


@pytest.fixture
def folder(tmp_path):
    return shortened(tmp_path / "walk", 30)


def test_missing_velocities_are_computed_from_positions_and_missing_times_from_dt_s(folder):
    expected = read_deepmimo(folder)
    lines = (folder / TRUTH).read_text().splitlines()
    (folder / TRUTH).write_text("\n".join(",".join(line.split(",")[:4]) for line in lines))
    recording = read_deepmimo(folder)
    assert_array_equal(recording.measurement[:, :12], expected.measurement[:, :12])
    assert_allclose(recording.velocity_mps, expected.velocity_mps, atol=0.06)
    (folder / TRUTH).unlink()
    recording = read_deepmimo(folder, dt_s=0.1)
    assert_allclose(recording.time_s, expected.time_s, atol=1e-9)
    assert_array_equal(recording.position_m, load(folder, "rx_pos"))
    assert_allclose(recording.velocity_mps, expected.velocity_mps, atol=0.06)
    shifts_hz = recording.measurement[:, -1], expected.measurement[:, -1]
    assert_allclose(*shifts_hz, atol=5.0)


@pytest.mark.parametrize("dt_s", [0.0, float("nan")])
def test_an_impossible_time_between_epochs_is_refused(folder, dt_s):
    with refuses("dt_s"):
        read_deepmimo(folder, dt_s=dt_s)


def test_impossible_speeds_and_time_steps_are_refused_without_a_sidecar(folder):
    with refuses(folder, "row 2: t"):
        read_deepmimo(folder, dt_s=100.0)  # meant as 100 ms, but dt_s is in seconds
    edit(folder, "rx_pos", lambda a: np.where(np.arange(30)[:, None] < 9, a, a + 50.0))
    with refuses(folder, "row 10: speed"):
        read_deepmimo(folder, dt_s=0.1)
