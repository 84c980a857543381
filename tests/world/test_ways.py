"""Tests of ways (trajectories from which episodes are drawn), trajectories, and ``scenario=``."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.ways import read_trajectory, read_ways, scenario_from
from mmwave_env.models.envelope import POSITION_M
from mmwave_env.models.scene import SCENES
from mmwave_env.world.mobility import MOBILITIES, Mobility
from mmwave_env.world.trajectory import PlacedWays, Trajectory, Ways, users_of
from tests.filters.tracks import street_source
from tests.refusals import refuses

STREET = SCENES["street"]
BEYOND_M = 2.0 * POSITION_M.least


def straight(seconds, y=-80.0, speed=2.0, name="way"):
    t = np.arange(seconds + 1.0)
    return Trajectory(name, t, np.column_stack([20.0 + speed * t, y + 0 * t, 1.5 + 0 * t]))


def write(folder, rows, header=None):
    """Write a CSV file, by default with the columns t, x, y, z or t, x, y, z, vx, vy, vz."""
    header = header or ",".join(["t", "x", "y", "z", "vx", "vy", "vz"][: len(rows[0])])
    path = folder / "ways.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def write_ways(folder, ways):
    """Write ways (id -> way) to a file with rows sorted by time, as traffic simulators do."""
    rows = [
        (t, i, *position)
        for i, way in ways.items()
        for t, position in zip(way.time_s, way.position_m, strict=True)
    ]
    return write(folder, sorted(rows), "t,id,x,y,z")


def test_rows_with_the_same_id_are_the_way_of_one_user(tmp_path):
    ways = {"car 7": straight(9), "walker": straight(5, -70.0, 1.0)}
    path = write_ways(tmp_path, ways)
    users = read_ways(path)
    assert users.name == str(path)
    assert [way.name for way in users.trajectories] == [f"{name} of {path}" for name in ways]
    for way, expected in zip(users.trajectories, ways.values(), strict=True):
        assert_array_equal(way.time_s, expected.time_s)
        assert_array_equal(way.position_m, expected.position_m)


def test_each_episode_is_a_window_of_one_of_the_ways(tmp_path):
    ways = {"a": straight(30, -80.0), "b": straight(40, -70.0), "c": straight(60, -60.0)}
    source = street_source(read_ways(write_ways(tmp_path, ways)), epochs=25)
    names = set()
    for episode in source.episodes(np.arange(40, dtype=np.uint64)):
        way = ways[episode.name[0]]
        rows = np.flatnonzero(way.position_m[:, 0] == episode.truth_position_m[0, 0])
        window = way.position_m[rows[0] : rows[0] + 25]
        assert_allclose(episode.truth_position_m, window, atol=1e-9)
        names.add(episode.name)
    assert names == set(source.names) and len(names) == 3


def test_ways_shorter_than_an_episode_are_left_out():
    ways = Ways("many", [straight(n, name=str(n)) for n in (5, 30, 60)])
    with pytest.warns(UserWarning, match="many: found 1 of 3"):
        assert ways.placed(STREET, 1.0, 30).names == ["30", "60"]
    with pytest.warns(UserWarning, match="many: found 2 of 3"):
        placed = ways.placed(STREET, 1.0, 200)
    assert placed.names == ["60"] and placed.epochs == 61
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(ways.placed(STREET, 1.0, 6).names) == 3


def test_all_ways_are_equally_likely_and_so_are_all_windows_of_a_way():
    tables = [100.0 * i + np.tile(np.arange(n)[:, None], 6) for i, n in enumerate((10, 12, 40))]
    ways = PlacedWays(["a", "b", "c"], tables, 10)
    n = 90_000
    numbers, truth = ways.draw((np.arange(n) + 0.5) / n)
    assert truth.shape == (n, 10, 6) and np.bincount(numbers).tolist() == [n // 3] * 3
    for way, windows in enumerate((1, 3, 31)):
        starts = truth[numbers == way, 0, 0] - 100.0 * way
        counts = np.bincount(starts.astype(int))
        assert len(counts) == windows and np.ptp(counts) <= 1
    assert_array_equal(np.diff(truth[:, :, 0], axis=1), 1.0)


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda rows: rows[:-1] + ["3,,26,-80,1.5"], "line 5, column id"),
        (lambda rows: rows[:-1] + ["3,a,26,-80"], "line 5"),
        (lambda rows: rows[:1], "ways.csv"),
        (lambda rows: rows + ["9,b,26,-80,1.5", "9,b,27,-80,1.5"], "line 7: t"),
    ],
)
def test_the_error_about_a_damaged_file_names_the_place(tmp_path, change, place):
    path = write_ways(tmp_path, {"a": straight(3)})
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    with refuses(path, place):
        read_ways(path)


def test_several_ways_are_refused_where_a_single_trajectory_is_expected(tmp_path):
    path = write_ways(tmp_path, {"a": straight(3), "b": straight(3)})
    with refuses(path, "column id"):
        read_trajectory(path)


@pytest.mark.parametrize(("name", "as_type"), [("ways.csv", Path), ("WAYS.CSV", str)])
def test_a_csv_file_given_as_scenario_is_read_as_ways(tmp_path, name, as_type):
    path = write_ways(tmp_path, {"a": straight(3)}).rename(tmp_path / name)
    assert isinstance(scenario_from(as_type(path)), Ways)
    assert scenario_from("mixed") == "mixed"


def test_objects_and_known_names_can_be_given_as_scenarios():
    way = straight(3)
    ways = Ways("both", [way, way])
    assert users_of(ways) is ways
    assert users_of(way).trajectories == (way,) and users_of(way).name == "way"
    assert users_of(MOBILITIES["jam"]) == (MOBILITIES["jam"],)
    assert all(isinstance(user, Mobility) for user in users_of("mixed"))
    for unknown in ("boat", 3):
        with refuses("scenario"):
            users_of(unknown)


# --- trajectories

# rows t, x, y, z of a user who walks from west to east
ROWS = [[float(i), 20.0 + 2.0 * i, -80.0, 1.5] for i in range(5)]


def changed(row, column, value):
    """Return ROWS with one value changed."""
    rows = [[*row] for row in ROWS]
    rows[row][column] = value
    return rows


def test_columns_may_be_in_any_order_and_other_columns_are_ignored(tmp_path):
    rows = [[x, "car 7", 0.1, t, 2.5, z, y, 0.0] for t, x, y, z in ROWS]
    read = read_trajectory(write(tmp_path, rows, "x,id,vy,t,vx,z,y,vz"))
    assert_array_equal(read.time_s, np.array(ROWS)[:, 0])
    assert_array_equal(read.position_m, np.array(ROWS)[:, 1:])
    assert_array_equal(read.velocity_mps, np.tile([2.5, 0.1, 0.0], (5, 1)))


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
        (ROWS[:1], "ways.csv"),
        (changed(2, 0, 1.0), "line 4: t"),
        (changed(3, 0, "nan"), "line 5, column t"),
        (changed(4, 0, 20.0), "line 6: t"),
        (changed(1, 1, 900.0), "line 3: speed since the row before"),
        ([[t, x, 20.0 + 3.0 * t, z] for t, x, _, z in ROWS], "line 4: x, y, z"),
        ([[*row, 200.0 * row[0], 0.0, 0.0] for row in ROWS], "line 3: vx, vy, vz"),
        ([[*row, 3.6 * 2.0, 0.0, 0.0] for row in ROWS], "ways.csv: vx, vy, vz"),  # km/h
    ],
)
def test_the_error_about_an_impossible_trajectory_names_the_place(tmp_path, rows, place):
    path = write(tmp_path, rows)
    with refuses(path, place):
        street_source(read_ways(path))


@pytest.mark.parametrize("header", ["time,x,y,z", "t,x,y,vx"])
def test_a_file_that_lacks_a_column_is_refused(tmp_path, header):
    with refuses("ways.csv", "header"):
        read_trajectory(write(tmp_path, ROWS, header))


def test_a_trajectory_of_a_user_who_never_moves_causes_a_warning():
    time_s = np.arange(100.0)
    degrees = np.column_stack([-122.4 + 1e-6 * time_s, np.full(100, 37.8), np.full(100, 1.5)])
    with pytest.warns(UserWarning, match="gps: found all positions of 99 s"):
        Trajectory("gps", time_s, degrees)
    with warnings.catch_warnings(action="error"):  # no place on Earth in degrees
        Trajectory("static test", time_s, np.tile([300.0, 250.0, 1.5], (100, 1)))


@pytest.mark.parametrize(
    ("ends", "dt", "place"),
    [
        (([0, -20, 1.5], [50, 60, 1.5]), 1.0, "row 7: x, y, z"),  # behind a wall
        (([5, 5, 10], [15, 15, 10]), 1.0, "row 6: x, y, z"),  # at an anchor
        (([-9e5, -5e5, 1], [-9e5, -5e5 + 50, 1]), 1.0, "row 1: x, y, z"),  # far from the anchors
        (([BEYOND_M, 0, 1], [BEYOND_M, 50, 1]), 1.0, "row 1: x, y, z"),
        (([0, -20, 1], [50, -20, 1]), 20.0, "mine"),  # lasts 10 s, shorter than a step
    ],
)
def test_a_trajectory_that_does_not_fit_the_scene_is_refused(ends, dt, place):
    with refuses("mine", place):
        way = Trajectory("mine", np.arange(11.0), np.linspace(*ends, 11))
        street_source(way, dt=dt)
