"""Tests that trajectories in files and arrays are resampled, and refused if impossible."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.ways import read_trajectory, read_ways
from mmwave_env.world.trajectory import Trajectory
from tests.filters.tracks import street_source
from tests.refusals import refuses


def straight(n=5, dt=1.0, speed=2.0):
    """Return the rows of a user who walks from west to east."""
    return [[i * dt, 20.0 + speed * i * dt, -80.0, 1.5] for i in range(n)]


def write(folder, rows, header=None):
    """Write a CSV file, by default with the columns t, x, y, z or t, x, y, z, vx, vy, vz."""
    header = header or ",".join(["t", "x", "y", "z", "vx", "vy", "vz"][: len(rows[0])])
    path = folder / "way.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def changed(row, column, value):
    """Return the rows of :func:`straight` with one value changed."""
    rows = straight()
    rows[row][column] = value
    return rows


def test_columns_may_be_in_any_order_and_other_columns_are_ignored(tmp_path):
    rows = [[x, "car 7", 0.1, t, 2.5, z, y, 0.0] for t, x, y, z in straight()]
    read = read_trajectory(write(tmp_path, rows, "x,id,vy,t,vx,z,y,vz"))
    assert_array_equal(read.time_s, np.array(straight())[:, 0])
    assert_array_equal(read.position_m, np.array(straight())[:, 1:])
    assert_array_equal(read.velocity_mps, np.tile([2.5, 0.1, 0.0], (5, 1)))


@settings(deadline=None)  # the first example imports SciPy
@given(
    dt=st.floats(0.05, 3.0),
    steps=st.lists(st.floats(0.1, 4.0), min_size=4, max_size=30),
    a=st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
    v=st.lists(st.floats(-9.0, 9.0), min_size=3, max_size=3).filter(lambda v: abs(v[0]) > 1.0),
)
def test_constant_acceleration_is_resampled_exactly(dt, steps, a, v):
    """Check resampled rows, and velocities computed from positions (except the first and last)."""
    t = np.cumsum(steps)
    position = np.outer(t, v) + 0.5 * np.outer(t * t, a)
    velocity = v + np.outer(t, a)
    differences = Trajectory("drawn", t, position).velocity_mps
    assert_allclose(differences[1:-1], velocity[1:-1], atol=1e-6)
    way = Trajectory("drawn", t, position, velocity).resampled(dt)
    at = t[0] + dt * np.arange(len(way))
    assert at[-1] <= t[-1] + 1e-9 < at[-1] + dt + 2e-9
    assert_allclose(way[:, :3], np.outer(at, v) + 0.5 * np.outer(at * at, a), atol=1e-6)
    assert_allclose(way[:, 3:], v + np.outer(at, a), atol=1e-5)


@pytest.mark.parametrize(
    ("rows", "place"),
    [
        (straight(1), "way.csv"),
        (changed(2, 0, 1.0), "line 4: t"),
        (changed(3, 0, "nan"), "line 5, column t"),
        (changed(4, 0, 20.0), "line 6: t"),
        (changed(1, 1, 900.0), "line 3: speed since the row before"),
        ([[t, x, 20.0 + 3.0 * t, z] for t, x, _, z in straight()], "line 4: x, y, z"),
        ([[*row, 200.0 * row[0], 0.0, 0.0] for row in straight()], "line 3: vx, vy, vz"),
        ([[*row, 3.6 * 2.0, 0.0, 0.0] for row in straight()], "way.csv: vx, vy, vz"),  # km/h
    ],
)
def test_the_error_about_an_impossible_trajectory_names_the_place(tmp_path, rows, place):
    path = write(tmp_path, rows)
    with refuses(path, place):
        street_source(read_ways(path))


@pytest.mark.parametrize("header", ["time,x,y,z", "t,x,y,vx"])
def test_a_file_that_lacks_a_column_is_refused(tmp_path, header):
    with refuses("way.csv", "header"):
        read_trajectory(write(tmp_path, straight(), header))


def test_a_trajectory_of_a_user_who_never_moves_causes_a_warning():
    time_s = np.arange(100.0)
    degrees = np.column_stack([-122.4 + 1e-6 * time_s, np.full(100, 37.8), np.full(100, 1.5)])
    with pytest.warns(UserWarning, match="gps: found all positions of 99 s"):
        Trajectory("gps", time_s, degrees)


@pytest.mark.parametrize(
    ("ends", "dt", "place"),
    [
        (([0, -20, 1.5], [50, 60, 1.5]), 1.0, "row 7: x, y, z"),  # behind a wall
        (([5, 5, 10], [15, 15, 10]), 1.0, "row 6: x, y, z"),  # at an anchor
        (([-9e5, -5e5, 1], [-9e5, -5e5 + 50, 1]), 1.0, "row 1: x, y, z"),  # far from the anchors
        (([-2e6, 0, 1], [-2e6, 50, 1]), 1.0, "row 1: x, y, z"),  # beyond 1e6 m
        (([0, -20, 1], [50, -20, 1]), 20.0, "mine"),  # lasts 10 s, shorter than a step
    ],
)
def test_a_trajectory_that_does_not_fit_the_scene_is_refused(ends, dt, place):
    with refuses("mine", place):
        way = Trajectory("mine", np.arange(11.0), np.linspace(*ends, 11))
        street_source(way, dt=dt)
