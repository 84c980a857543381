"""What a ``scenario=`` argument means, by what it is and what is in its file."""

import json
from pathlib import Path

import pytest

from mmwave_env.episodes.mobility import MOBILITIES, Mobility
from mmwave_env.episodes.scenarios import users_of
from mmwave_env.episodes.traffic import Traffic
from mmwave_env.episodes.trajectory import Trajectory

HERE = Path(__file__).parent
WAY = "t,x,y,z\n0,1,-80,1.5\n1,2,-80,1.5\n2,3,-80,1.5\n"
FCD = "timestep_time;vehicle_id;vehicle_x;vehicle_y\n0;a;1;2\n1;a;2;2\n"
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
        ("way.csv", WAY, Trajectory),
        ("traffic.csv", FCD, Traffic),
        ("traffic.CSV", FCD, Traffic),
        ("traffic.json", json.dumps({"fcd": "traffic.csv"}), Traffic),
        ("scooter.json", json.dumps(MOBILITY), tuple),
    ],
)
@pytest.mark.parametrize("as_given", [str, Path])
def test_a_file_is_what_is_in_it(tmp_path, name, content, kind, as_given):
    path = tmp_path / name
    path.write_text(content)
    assert isinstance(users_of(as_given(path)), kind)


def test_objects_are_taken_as_they_are():
    traffic = Traffic(str(HERE / "traffic.xml.gz"))
    assert users_of(traffic) is traffic
    assert users_of(MOBILITIES["jam"]) == (MOBILITIES["jam"],)
    assert all(isinstance(user, Mobility) for user in users_of("mixed"))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "a.json: not a mobility file"),
        ("a.json", "3", "a.json: not a mobility file: found int"),
        ("a.json", '{"fcd": "b.xml", "phases": []}', "a.json: not a traffic file: key: found 'ph"),
        ("a.csv", "1;2;3", "a.csv: header: found .*expected the columns t,x,y,z"),
        ("a.csv", "", "a.csv: header"),
    ],
)
def test_files_of_neither_kind_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message):
        users_of(tmp_path / name)


def test_names_that_there_are_not_are_refused():
    for name in ("walker", 3):
        with pytest.raises(ValueError, match=f"scenario: found '{name}', expected one of pedestr"):
            users_of(name)
