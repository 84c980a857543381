"""When a user was where: the sidecar, or a stated time between epochs."""

import numpy as np
import pytest

from mmwave_env.datasets.deepmimo import read_deepmimo
from tests.datasets.deepmimo.scenarios import TRUTH, edit, load, shortened


@pytest.fixture
def folder(tmp_path):
    return shortened(tmp_path / "walk", 30)


def test_without_a_sidecar_times_are_stated_and_velocities_are_differences(folder):
    expected = read_deepmimo(folder)
    (folder / TRUTH).unlink()
    found = read_deepmimo(folder, dt_s=0.1)
    np.testing.assert_allclose(found.time_s, expected.time_s, atol=1e-9)
    np.testing.assert_array_equal(found.position_m, load(folder, "rx_pos"))
    np.testing.assert_allclose(found.velocity_mps, expected.velocity_mps, atol=0.06)
    np.testing.assert_allclose(
        found.measurement[:, -1], expected.measurement[:, -1], atol=5.0
    )  # Hz


def test_without_either_both_are_named(folder):
    (folder / TRUTH).unlink()
    with pytest.raises(FileNotFoundError, match=f"{TRUTH}.*; or dt_s= of read_deepmimo"):
        read_deepmimo(folder)


@pytest.mark.parametrize("dt_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_time_between_epochs_that_is_none(folder, dt_s):
    with pytest.raises(ValueError, match=f"dt_s: found {dt_s}, expected > 0"):
        read_deepmimo(folder, dt_s=dt_s)


def test_velocities_may_be_left_to_the_positions(folder):
    expected = read_deepmimo(folder)
    lines = (folder / TRUTH).read_text().splitlines()
    (folder / TRUTH).write_text("\n".join(",".join(line.split(",")[:4]) for line in lines))
    found = read_deepmimo(folder)
    np.testing.assert_array_equal(found.measurement[:, :12], expected.measurement[:, :12])
    np.testing.assert_allclose(found.velocity_mps, expected.velocity_mps, atol=0.06)


SPOILT = {
    "a jump": (lambda f: jump(f, 21.0), {}, r"line 12: m/s since the row before: found 219"),
    "a jump of the receivers": (
        lambda f: edit(f, "rx_pos", lambda a: np.where(np.arange(30)[:, None] < 9, a, a + 50.0)),
        {"dt_s": 0.1},
        "row 10: m/s since the row before: found 8.*is t in seconds, and are x, y in meters",
    ),
    "a time in milliseconds": (
        lambda f: scale(f, 0, 1e3),
        {},
        "line 3: t: found 100, expected at most 15 s .* if t is in s",
    ),
    "a time in nanoseconds": (lambda f: scale(f, 0, 1e9), {}, "line 3: t: found 1e.08"),
    "a stated time in milliseconds": (
        lambda f: None, {"dt_s": 100.0}, "row 2: t: found 100, expected at most 15 s",
    ),
    "a stated time of another unit": (lambda f: None, {"dt_s": 1e-4}, "row 2: m/s since"),
    "velocities in km/h, of a hundredth": (
        lambda f: [scale(f, column, 3.6) for column in (4, 5, 6)],
        {},
        "vx, vy, vz: found a way of .*are they in m/s",
    ),
}  # fmt: skip


def table(folder):
    return np.loadtxt(folder / TRUTH, delimiter=",", skiprows=1)


def write(folder, rows):
    lines = [",".join(f"{value:.6f}" for value in row) for row in rows]
    (folder / TRUTH).write_text("\n".join(["t,x,y,z,vx,vy,vz", *lines]))


def scale(folder, column, factor):
    rows = table(folder)
    rows[:, column] *= factor
    write(folder, rows)


def jump(folder, metres):
    rows = table(folder)
    rows[10:, 1] += metres
    write(folder, rows)


@pytest.mark.parametrize("what", SPOILT)
def test_a_way_that_no_user_goes_is_named(folder, what):
    spoil, arguments, expected = SPOILT[what]
    spoil(folder)
    with pytest.raises(ValueError, match=expected) as error:
        read_deepmimo(folder, **arguments)
    assert str(folder) in str(error.value)
