"""Ways of one's own: read, resampled, and refused where they can't be sent through the channel."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.datasets.ways import read_trajectory, read_ways
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.trajectory import Trajectory

STREET = SCENES["street"]


def straight(n=5, dt=1.0, speed=2.0):
    """Rows of someone who walks west to east."""
    return [[i * dt, 20.0 + speed * i * dt, -80.0, 1.5] for i in range(n)]


def write(folder, rows, header="t,x,y,z"):
    path = folder / "way.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def changed(row, column, value, **how):
    rows = straight(**how)
    rows[row][column] = value
    return rows


def test_a_file_is_the_rows_it_has(tmp_path):
    rows = np.array(straight())
    read = read_trajectory(write(tmp_path, rows))
    np.testing.assert_array_equal(read.time_s, rows[:, 0])
    np.testing.assert_array_equal(read.position_m, rows[:, 1:])
    np.testing.assert_allclose(read.velocity_mps, np.tile([2.0, 0.0, 0.0], (5, 1)), atol=1e-12)


def test_columns_come_in_any_order_and_others_are_not_looked_at(tmp_path):
    rows = [[row[1], "car 7", row[0], row[3], row[2]] for row in straight()]
    read = read_trajectory(write(tmp_path, rows, "x,id,t,z,y"))
    np.testing.assert_array_equal(read.position_m, np.array(straight())[:, 1:])


def test_velocities_of_a_file_are_taken(tmp_path):
    rows = [[*row, 2.5, 0.1, 0.0] for row in straight()]
    read = read_trajectory(write(tmp_path, rows, "t,x,y,z,vx,vy,vz"))
    np.testing.assert_array_equal(read.velocity_mps, np.tile([2.5, 0.1, 0.0], (5, 1)))


@settings(deadline=None)  # the first draw imports SciPy
@given(
    dt=st.floats(0.05, 3.0),
    steps=st.lists(st.floats(0.1, 4.0), min_size=4, max_size=30),
    a=st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
    v=st.lists(st.floats(-9.0, 9.0), min_size=3, max_size=3),
)
def test_constant_acceleration_is_resampled_as_it_is(dt, steps, a, v):
    """Differences find its velocities, but for the ends, and the cubics its positions."""
    t = np.cumsum(steps)
    position = np.outer(t, v) + 0.5 * np.outer(t * t, a)
    given_velocity = v + np.outer(t, a)
    found = Trajectory("drawn", t, position).velocity_mps
    np.testing.assert_allclose(found[1:-1], given_velocity[1:-1], atol=1e-6)
    way = Trajectory("drawn", t, position, given_velocity).resampled(dt)
    at = t[0] + dt * np.arange(len(way))
    assert at[-1] <= t[-1] + 1e-9 < at[-1] + dt + 2e-9
    np.testing.assert_allclose(way[:, :3], np.outer(at, v) + 0.5 * np.outer(at * at, a), atol=1e-6)
    np.testing.assert_allclose(way[:, 3:], v + np.outer(at, a), atol=1e-5)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (straight(1), "found 1 rows, expected at least 2"),
        (changed(2, 0, 1.0), "line 4: t: found 1, expected more than in the row before"),
        (changed(3, 0, "nan"), "line 5, column t: found 'nan', expected a finite number"),
        (changed(1, 1, ""), "line 3, column x: found '', expected a finite number"),
        (changed(4, 0, 20.0), "line 6: t: found 20, expected at most 15 s after the row before"),
        (changed(1, 1, 900.0), "line 3: m/s since the row before: found 880, expected at most 100"
                               " m/s: is t in seconds, and are x, y in meters"),
        (straight(5, 1.0, 20.0)[:4] + [[4.0, 100.0]], "line 6: found 2 values, expected 4"),
        (changed(4, 1, 60.0, speed=-20.0), "line 4.*expected y below 25 m"),
    ],
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)  # fmt: skip
def test_a_file_that_no_user_went_is_refused_by_line(tmp_path, rows, message):
    path = write(tmp_path, rows)
    if "y below" in message:
        path = write(tmp_path, [[t, x, 20.0 + 3.0 * t, z] for t, x, _, z in straight()])
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}.*{message}"):
        SimulatedSource(STREET, RADIOS["handset"], read_ways(path))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("time,x,y,z", "header: found 'time,x,y,z', expected the columns t,x,y,z"),
        ("t,x,y,vx", "expected the columns t,x,y,z,vx,vy,vz"),
    ],
)
def test_a_file_without_its_columns_is_refused(tmp_path, header, message):
    with pytest.raises(ValueError, match=f"way.csv: .*{message}"):
        read_trajectory(write(tmp_path, straight(), header))


def test_a_missing_file_is_named():
    with pytest.raises(FileNotFoundError, match="nowhere.csv: found no such file"):
        read_trajectory("nowhere.csv")


def test_velocities_beyond_any_user_are_refused_by_line(tmp_path):
    rows = [[*row, 2.0, 0.0, 0.0] for row in straight()]
    rows[3][4] = 720.0
    with pytest.raises(ValueError, match="line 5: vx, vy, vz: found 720, 0, 0, expected at most"):
        read_trajectory(write(tmp_path, rows, "t,x,y,z,vx,vy,vz"))


def test_velocities_in_kilometers_per_hour_are_refused(tmp_path):
    rows = [[*row, 3.6 * 2.0, 0.0, 0.0] for row in straight()]
    with pytest.raises(ValueError, match="way of 28.8 m, expected that of the positions, 8 m: are"):
        read_trajectory(write(tmp_path, rows, "t,x,y,z,vx,vy,vz"))


def test_arrays_are_refused_by_row():
    time_s, position = np.arange(5.0), np.zeros((5, 3))
    position[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"mine, row 3: x, y, z: found 0, nan, 0, expected finite"):
        Trajectory("mine", time_s, position)
    with pytest.raises(ValueError, match=r"position_m of mine: found shape \(4, 3\)"):
        Trajectory("mine", time_s, position[:4])


def test_one_who_never_moves_is_perhaps_in_degrees():
    time_s = np.arange(100.0)
    position = np.column_stack([-122.4 + 1e-6 * time_s, np.full(100, 37.8), np.full(100, 1.5)])
    with pytest.warns(UserWarning, match="gps: found all of 99 s within 0.1 m.*in degrees?"):
        Trajectory("gps", time_s, position)


def test_a_way_behind_a_wall_or_at_an_anchor_is_refused():
    def way(*ends):
        return Trajectory("mine", np.arange(11.0), np.linspace(*ends, 11))

    with pytest.raises(
        ValueError, match=r"mine, row 7: x, y, z: found 30, 28, 1.5, expected y below 25 m, where"
    ):
        SimulatedSource(STREET, RADIOS["handset"], way([0, -20, 1.5], [50, 60, 1.5]))
    with pytest.raises(ValueError, match="mine, row 6: .*5000 m from the anchor at .10.0"):
        SimulatedSource(STREET, RADIOS["handset"], way([5, 5, 10], [15, 15, 10]))
    with pytest.raises(ValueError, match="mine, row 1: .* a place 1 to 5000 m from the anchor"):
        SimulatedSource(STREET, RADIOS["handset"], way([-9e5, -5e5, 1], [-9e5, -5e5 + 50, 1]))
    with pytest.raises(ValueError, match="mine, row 1: x, y, z: found -2e.06, .* to 1e.06 m"):
        way([-2e6, 0, 1], [-2e6, 50, 1])
    with pytest.raises(ValueError, match="mine: found 10 s, expected 20, dt"):
        SimulatedSource(STREET, RADIOS["handset"], way([0, -20, 1], [50, -20, 1]), dt=20.0)


def test_windows_begin_anywhere_and_a_short_way_is_one_episode():
    rows = np.array(straight(7))
    walk = Trajectory("walk", rows[:, 0], rows[:, 1:])
    source = SimulatedSource(STREET, RADIOS["handset"], walk, epochs=4)
    begins = set()
    for seed in range(40):
        truth = source.sample(np.random.default_rng(seed)).truth_position_m
        np.testing.assert_allclose(np.diff(truth[:, 0]), 2.0)
        begins.add(round(truth[0, 0]))
    assert begins == {20, 22, 24, 26}
    assert SimulatedSource(STREET, RADIOS["handset"], walk).epochs == 7
    assert source.name == "walk"
