"""Tests of ways: scenario=, and files of several users, read, placed and drawn from."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from mmwave_env.datasets.ways import read_trajectory, read_ways, scenario_from
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.mobility import MOBILITIES, Mobility
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.trajectory import PlacedWays, Trajectory, Ways, users_of

STREET, RADIO = SCENES["street"], RADIOS["handset"]


def straight(seconds, y=-80.0, speed=2.0, name="way"):
    t = np.arange(seconds + 1.0)
    return Trajectory(name, t, np.column_stack([20.0 + speed * t, y + 0 * t, 1.5 + 0 * t]))


def write(folder, ways, header="t,id,x,y,z"):
    """A file of ways by id, in the order of time as traffic simulators write them."""
    rows = [(t, i, *p) for i, way in ways.items()
            for t, p in zip(way.time_s, way.position_m, strict=True)]  # fmt: skip
    path = folder / "ways.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in sorted(rows))]) + "\n")
    return path


def test_rows_of_an_id_are_the_way_of_one_user(tmp_path):
    ways = {"car 7": straight(9), "walker": straight(5, -70.0, 1.0)}
    path = write(tmp_path, ways)
    found = read_ways(path)
    assert found.name == str(path)
    assert [way.name for way in found.trajectories] == [f"{name} of {path}" for name in ways]
    for way, expected in zip(found.trajectories, ways.values(), strict=True):
        np.testing.assert_array_equal(way.time_s, expected.time_s)
        np.testing.assert_array_equal(way.position_m, expected.position_m)


def test_each_episode_is_a_window_of_one_of_the_ways(tmp_path):
    ways = {"a": straight(30, -80.0), "b": straight(40, -70.0), "c": straight(60, -60.0)}
    source = SimulatedSource(STREET, RADIO, read_ways(write(tmp_path, ways)), epochs=25)
    seen = set()
    for episode in source.episodes(np.arange(40, dtype=np.uint64)):
        way = ways[episode.name[0]]
        rows = np.flatnonzero(way.position_m[:, 0] == episode.truth_position_m[0, 0])
        window = way.position_m[rows[0] : rows[0] + 25]
        np.testing.assert_allclose(episode.truth_position_m, window, atol=1e-9)
        seen.add(episode.name)
    assert seen == set(source.names) and len(seen) == 3


def test_one_of_several_ways_is_drawn_as_it_would_be_alone(tmp_path):
    path = write(tmp_path, {"a": straight(40)})
    alone = SimulatedSource(STREET, RADIO, straight(40), epochs=20)
    named = SimulatedSource(STREET, RADIO, read_ways(path), epochs=20)
    for seed in range(3):
        a, b = (s.sample(np.random.default_rng(seed)) for s in (alone, named))
        np.testing.assert_array_equal(a.truth_position_m, b.truth_position_m)
        np.testing.assert_array_equal(a.measurement, b.measurement)


def test_ways_shorter_than_an_episode_are_left_out():
    ways = Ways("many", [straight(n, name=str(n)) for n in (5, 30, 60)])
    with pytest.warns(UserWarning, match="many: found 1 of 3 ways shorter than 29 s, an episode"):
        assert ways.placed(STREET, 1.0, 30).names == ["30", "60"]
    with pytest.warns(UserWarning, match="many: found 2 of 3 ways shorter than 60 s"):
        placed = ways.placed(STREET, 1.0, 200)
    assert placed.names == ["60"] and placed.epochs == 61
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(ways.placed(STREET, 1.0, 6).names) == 3


def test_all_ways_are_as_likely_and_all_windows_of_one():
    tables = [100.0 * i + np.tile(np.arange(n)[:, None], 6) for i, n in enumerate((10, 12, 40))]
    ways, n = PlacedWays(["a", "b", "c"], tables, 10), 90_000
    which, truth = ways.draw((np.arange(n) + 0.5) / n)
    assert truth.shape == (n, 10, 6) and np.bincount(which).tolist() == [n // 3] * 3
    for way, windows in enumerate((1, 3, 31)):
        starts = truth[which == way, 0, 0] - 100.0 * way
        counts = np.bincount(starts.astype(int))
        assert len(counts) == windows and np.ptp(counts) <= 1
    np.testing.assert_array_equal(np.diff(truth[:, :, 0], axis=1), 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:-1] + ["3,,26,-80,1.5"], "line 5, column id: found '', expected 1 to"),
        (lambda rows: rows[:-1] + ["3,a,26,-80"], "line 5: found 4 values, expected 5"),
        (lambda rows: rows[:2], "a of .*ways.csv: found 1 rows, expected at least 2"),
        (lambda rows: rows[:1], "ways.csv: found 0 rows"),
        (lambda rows: rows + ["9,b,26,-80,1.5", "9,b,27,-80,1.5"], "b of .*, line 7: t: found 9"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path, change, message):
    path = write(tmp_path, {"a": straight(3)})
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    with pytest.raises(ValueError, match=message) as error:
        read_ways(path)
    assert str(path) in str(error.value)


def test_where_one_way_is_expected_several_are_refused(tmp_path):
    path = write(tmp_path, {"a": straight(3), "b": straight(3)})
    with pytest.raises(ValueError, match="ways.csv: column id: found 2 users, expected one"):
        read_trajectory(path)


# --- what a scenario is

WAY = "t,x,y,z\n0,1,-80,1.5\n1,2,-80,1.5\n2,3,-80,1.5\n"
MOBILITY = {
    "phases": [
        {
            "limits": {
                "acceleration_mps2": [1.0, 1.0], "braking_mps2": [1.0, 1.0],
                "lateral_mps2": [1.0, 1.0], "jerk_mps3": 1.0, "corner_radius_m": 2.0,
            },
            "gaits": [{"low_mps": 1.0, "high_mps": 2.0}],
        }
    ]
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("way.csv", WAY, Ways),
        ("WAY.CSV", WAY, Ways),
        ("scooter.json", json.dumps(MOBILITY), tuple),
    ],
)
@pytest.mark.parametrize("as_given", [str, Path])
def test_a_file_is_what_its_ending_says(tmp_path, name, content, kind, as_given):
    path = tmp_path / name
    path.write_text(content)
    assert isinstance(users_of(scenario_from(as_given(path))), kind)


def test_objects_are_taken_as_they_are():
    walk = Trajectory("walk", [0.0, 1.0], [[1.0, -80.0, 1.5], [2.0, -80.0, 1.5]])
    ways = Ways("both", [walk, walk])
    assert users_of(ways) is ways
    assert users_of(walk).trajectories == (walk,) and users_of(walk).name == "walk"
    assert users_of(MOBILITIES["jam"]) == (MOBILITIES["jam"],)
    assert all(isinstance(user, Mobility) for user in users_of("mixed"))


def test_names_that_there_are_not_are_refused():
    for name in ("boat", 3):
        with pytest.raises(ValueError, match=f"scenario: found '{name}', expected one of pedestr"):
            users_of(name)
