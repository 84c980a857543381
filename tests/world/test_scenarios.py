"""What a ``scenario=`` argument means, by what it is and what is in its file."""

import json
from pathlib import Path

import pytest

from mmwave_env.world.mobility import MOBILITIES, Mobility
from mmwave_env.world.scenarios import users_of
from mmwave_env.world.trajectory import Trajectory
from mmwave_env.world.ways import Ways

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
    assert isinstance(users_of(as_given(path)), kind)


def test_objects_are_taken_as_they_are():
    walk = Trajectory("walk", [0.0, 1.0], [[1.0, -80.0, 1.5], [2.0, -80.0, 1.5]])
    ways = Ways("both", [walk, walk])
    assert users_of(ways) is ways
    assert users_of(walk).trajectories == (walk,) and users_of(walk).name == "walk"
    assert users_of(MOBILITIES["jam"]) == (MOBILITIES["jam"],)
    assert all(isinstance(user, Mobility) for user in users_of("mixed"))


@pytest.mark.parametrize("name", ["town.xml", "town.xml.gz", "town.parquet"])
def test_files_of_sumo_are_sent_to_the_example_that_converts_them(name):
    with pytest.raises(ValueError, match=f"found '{name}', expected a .csv .* examples/sumo.py"):
        users_of(name)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "a.json: not a mobility file"),
        ("a.json", "3", "a.json: not a mobility file: found int"),
        ("a.csv", "1;2;3", "a.csv: header: found .*expected the columns t,x,y,z"),
        ("a.csv", "", "a.csv: header"),
    ],
)
def test_files_of_neither_kind_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message):
        users_of(tmp_path / name)


def test_names_that_there_are_not_are_refused():
    for name in ("boat", 3):
        with pytest.raises(ValueError, match=f"scenario: found '{name}', expected one of pedestr"):
            users_of(name)
