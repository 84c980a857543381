"""Tests of ways (trajectories from which episodes are drawn) and of the argument ``scenario=``."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.ways import read_trajectory, read_ways, scenario_from
from mmwave_env.models.scene import SCENES
from mmwave_env.world.mobility import MOBILITIES, Mobility
from mmwave_env.world.trajectory import PlacedWays, Trajectory, Ways, users_of
from tests.filters.tracks import street_source
from tests.refusals import refuses

STREET = SCENES["street"]


def straight(seconds, y=-80.0, speed=2.0, name="way"):
    t = np.arange(seconds + 1.0)
    return Trajectory(name, t, np.column_stack([20.0 + speed * t, y + 0 * t, 1.5 + 0 * t]))


def write(folder, ways):
    """Write ways (id -> way) to a file with rows sorted by time, as traffic simulators do."""
    pairs = [
        (i, row) for i, way in ways.items() for row in zip(way.time_s, way.position_m, strict=True)
    ]
    rows = [(t, i, *position) for i, (t, position) in pairs]
    path = folder / "ways.csv"
    lines = ["t,id,x,y,z", *(",".join(map(str, row)) for row in sorted(rows))]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_rows_with_the_same_id_are_the_way_of_one_user(tmp_path):
    ways = {"car 7": straight(9), "walker": straight(5, -70.0, 1.0)}
    path = write(tmp_path, ways)
    users = read_ways(path)
    assert users.name == str(path)
    assert [way.name for way in users.trajectories] == [f"{name} of {path}" for name in ways]
    for way, expected in zip(users.trajectories, ways.values(), strict=True):
        assert_array_equal(way.time_s, expected.time_s)
        assert_array_equal(way.position_m, expected.position_m)


def test_each_episode_is_a_window_of_one_of_the_ways(tmp_path):
    ways = {"a": straight(30, -80.0), "b": straight(40, -70.0), "c": straight(60, -60.0)}
    source = street_source(read_ways(write(tmp_path, ways)), epochs=25)
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
    path = write(tmp_path, {"a": straight(3)})
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    with refuses(path, place):
        read_ways(path)


def test_several_ways_are_refused_where_a_single_trajectory_is_expected(tmp_path):
    path = write(tmp_path, {"a": straight(3), "b": straight(3)})
    with refuses(path, "column id"):
        read_trajectory(path)


@pytest.mark.parametrize(("name", "as_type"), [("ways.csv", Path), ("WAYS.CSV", str)])
def test_a_csv_file_given_as_scenario_is_read_as_ways(tmp_path, name, as_type):
    path = write(tmp_path, {"a": straight(3)}).rename(tmp_path / name)
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
