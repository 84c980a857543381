"""Traffic as a scenario: trips in a scene, one an episode."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from mmwave_env.episodes.fcd import read_fcd
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.episodes.traffic import Traffic, read_traffic
from mmwave_env.episodes.trajectory import Trajectory
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import SCENES, Scene, Wall
from mmwave_env.task import task_from

HERE = Path(__file__).parent
FILE = HERE / "traffic.xml.gz"
STREET, RADIO = SCENES["street"], RADIOS["handset"]
TRIPS = {trip.name: trip for trip in read_fcd(FILE, lambda name, kind: True)}


def source_of(traffic, **more):
    return SimulatedSource(STREET, RADIO, traffic, **({"dt": 0.5, "epochs": 50} | more))


def few(**more):
    """Traffic of which no trip is left out for good."""
    return Traffic(str(FILE), min_seconds=20.0, **more)


def fcd(path, trips):
    """A file of rows (t, x, y) by id."""
    rows = [f"{t};{name};{x};{y};car" for name, rows in trips.items() for t, x, y in rows]
    path.write_text("\n".join(["timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_type", *rows]))
    return path


def straight(begin=(0.0, 0.0), speed=5.0, seconds=40):
    return [(t, begin[0] + speed * t, begin[1]) for t in range(seconds + 1)]


@pytest.mark.parametrize("name", ["traffic.csv.gz", "traffic.parquet"])
def test_every_format_gives_the_same_episodes(name):
    if name.endswith(".parquet"):
        pytest.importorskip("pyarrow")
    one = source_of(few())
    other = source_of(Traffic(str(HERE / name), min_seconds=20.0))
    for seed in range(4):
        a, b = (s.sample(np.random.default_rng(seed)) for s in (one, other))
        assert a.name.split(" of ")[0] == b.name.split(" of ")[0]
        for field, value in vars(a).items():
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(value, getattr(b, field), field)


def test_an_episode_is_a_window_of_a_trip():
    source = source_of(few(shift_m=(20.0, -140.0)))
    assert source.name == "traffic.xml.gz" and not source.travels
    assert source.epochs == min(50, *map(len, source.ways.tables))
    seen = set()
    for episode in source.episodes(np.arange(40, dtype=np.uint64)):
        name, begin, end = source.ways.find(episode.truth_position_m)
        seen.add(name)
        trip = TRIPS[name.removesuffix(" of traffic.xml.gz")]
        assert episode.name == name and end - begin == 0.5 * (source.epochs - 1)
        rows = (trip.time_s >= begin) & (trip.time_s <= end)
        np.testing.assert_allclose(
            episode.truth_position_m[:, :2], trip.position_m[rows] + [20.0, -140.0], atol=1e-9
        )
        assert (episode.truth_position_m[:, 2] == STREET.streets.height_m).all()
    assert seen == set(source.ways.names)


def test_velocities_are_the_rates_of_change_of_positions():
    """SUMO's speed and angle are those of the vehicle, not of its front bumper in a turn."""
    source = source_of(few(), dt=0.1)
    episode = source.sample(np.random.default_rng(1))
    middle = np.diff(episode.truth_position_m, axis=0) / 0.1
    mean = 0.5 * (episode.truth_velocity_mps[1:] + episode.truth_velocity_mps[:-1])
    np.testing.assert_allclose(mean, middle, atol=0.5)
    assert np.abs(middle).max() > 1.0


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({"types": ("DEFAULT_PEDTYPE",)}, "pedestrian"),
        ({"ids": ("vehicle*",)}, "vehicle"),
        ({"ids": ("*1",), "types": ("*PED*",)}, "pedestrian1"),
    ],
)
def test_trips_are_chosen_by_type_and_id(chosen, expected):
    names = source_of(few(**chosen)).ways.names
    assert names and all(name.startswith(expected) for name in names)


def test_trips_last_as_long_as_is_asked_for():
    lasts = {name: np.ptp(trip.time_s) for name, trip in TRIPS.items()}
    for least in (20.0, 30.0):
        source = source_of(Traffic(str(FILE), min_seconds=least), epochs=1000)
        names = {name.split(" of ")[0] for name in source.ways.names}
        assert names == {name for name, seconds in lasts.items() if seconds >= least}
        shortest = min(lasts[name] for name in names)
        assert source.epochs == shortest / 0.5 + 1
        assert f"{len(TRIPS) - len(names)} shorter than {least:g} s" in source.ways.about


def test_without_a_least_length_trips_are_as_long_as_an_episode():
    source = source_of(Traffic(str(FILE)), epochs=31)
    assert source.epochs == 31 and all(len(table) >= 31 for table in source.ways.tables)
    with pytest.warns(
        UserWarning, match=r"left out: \d+ shorter than 59.5 s; there are more for shorter"
    ):
        source = source_of(Traffic(str(FILE)), epochs=1000)
    assert source.epochs == 120


# --- into the scene


def test_the_middle_of_the_traffic_becomes_that_of_the_streets(tmp_path):
    trips = {"a": straight((0.0, 0.0)), "b": straight((0.0, 100.0))}
    source = source_of(Traffic(str(fcd(tmp_path / "a.csv", trips))), dt=1.0, epochs=30)
    assert source.ways.about == "2 of 2 trips, moved by (-20, -130) m"


def test_traffic_stays_in_front_of_walls(tmp_path):
    """As a whole; 300 m from west to east would cross the wall at x = 185 m."""
    trips = {"a": straight((0.0, 0.0), 7.5), "b": straight((0.0, 240.0), 2.5)}
    source = source_of(Traffic(str(fcd(tmp_path / "a.csv", trips))), dt=1.0, epochs=30)
    assert source.ways.about == "2 of 2 trips, moved by (-116, -216) m"
    for wall in STREET.walls:
        room = [wall.signed_distance(table[:, :3].T) for table in source.ways.tables]
        assert np.concatenate(room).max() <= -1.0


def test_slanted_walls_count(tmp_path):
    scene = Scene("slanted", (0.0, 0.0, 10.0), (Wall((1.0, 1.0), 50.0), Wall((-1.0, 0.2), 90.0)))
    path = fcd(tmp_path / "a.csv", {"a": straight((0.0, 0.0), 2.0)})
    ways = Traffic(str(path)).ways(scene, 1.0, 30)
    for wall in scene.walls:
        assert wall.signed_distance(ways.tables[0][:, :3].T).max() < 0.0


def test_trips_that_nobody_can_go_are_left_out_and_counted(tmp_path):
    trips = {
        "good": straight((0.0, 0.0), 3.0),
        "other": straight((0.0, 10.0), 3.0),
        "third": straight((0.0, 20.0), 3.0),
        "fourth": straight((0.0, 30.0), 3.0),
        "behind": straight((0.0, 120.0), 3.0),
        "fast": [(0.0, 0.0, 0.0), (1.0, 500.0, 0.0), (2.0, 501.0, 0.0)],
        "gap": [(0.0, 0.0, 0.0), (1.0, 5.0, 0.0), (30.0, 10.0, 0.0), (40.0, 12.0, 0.0)],
        "parked": [(float(t), 7.0, 7.0) for t in range(100)],
        "short": straight(seconds=0) + [(0.4, 1.0, 0.0)],
    }
    traffic = Traffic(str(fcd(tmp_path / "a.csv", trips)), shift_m=(0.0, -80.0))
    said = (
        r"a.csv: 4 of 9 trips, moved by \(0, -80\) m; left out: 1 shorter than 29 s; 4 that nobody "
        r"can go here, the first: behind of a.csv, line 166: x, y, z: found 0, 40, 1.5, expected y "
        "below 25 m.*, where the base station is, of scene 'street'; there are more for shorter"
    )
    with pytest.warns(UserWarning, match=said):
        source = source_of(traffic, dt=1.0, epochs=30)
    assert source.ways.names == [
        f"{name} of a.csv" for name in ("good", "other", "third", "fourth")
    ]


def test_where_nobody_is_left_it_says_why(tmp_path):
    degrees = {"a": [(float(t), 13.4 + 1e-5 * t / 40, 52.5) for t in range(41)]}
    with pytest.raises(
        ValueError, match=r"a.csv: found 0 of 1 trips, .*within 0.1 m.*fcd-output.geo.*at least"
    ):
        source_of(Traffic(str(fcd(tmp_path / "a.csv", degrees))))
    with pytest.raises(ValueError, match=r"types DEFAULT_PEDTYPE, DEFAULT_VEHTYPE, expected.* bus"):
        source_of(Traffic(str(FILE), types=("bus",)))
    with pytest.raises(ValueError, match=r"0 of 16 trips, .*left out: 16 shorter than 900 s"):
        source_of(Traffic(str(FILE), min_seconds=900.0))
    (tmp_path / "none.xml").write_text("<fcd-export/>")
    with pytest.raises(ValueError, match="none.xml: found no vehicle and no person, expected"):
        source_of(tmp_path / "none.xml")


def test_traffic_needs_one_scene():
    with pytest.raises(ValueError, match="expected one scene: traffic.xml.gz is a way"):
        SimulatedSource(RandomScene(), RADIO, FILE)


# --- as files


def test_a_json_file_chooses(tmp_path):
    (tmp_path / "day").mkdir()
    (tmp_path / "day" / "traffic.xml.gz").write_bytes(FILE.read_bytes())
    path = tmp_path / "walkers.json"
    content = {"fcd": "day/traffic.xml.gz", "types": ["*PED*"], "min_seconds": 20,
               "shift_m": [20, -140]}  # fmt: skip
    path.write_text(json.dumps(content))
    traffic = read_traffic(path)
    assert traffic.name == "walkers" and traffic.fcd == str(tmp_path / "day" / "traffic.xml.gz")
    task = task_from(scenario=path, dt=0.5, episode_steps=30)
    assert task.source.name == "walkers" and task.source.ways.names == list(
        source_of(few(types=("*PED*",), name="walkers")).ways.names
    )
    assert "moved by (20, -140) m" in task.source.ways.about


@pytest.mark.parametrize("fcd", ["../traffic.xml.gz", "/etc/traffic.xml", "day/../../a.xml"])
def test_a_json_file_does_not_reach_out_of_its_folder(tmp_path, fcd):
    path = tmp_path / "traffic.json"
    path.write_text(json.dumps({"fcd": fcd}))
    message = f"traffic.json: not a traffic file: fcd: found {fcd!r}, expected a file in the folder"
    with pytest.raises(ValueError, match=re.escape(message)):
        task_from(scenario=path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"fcd": "a.xml", "type": ["x"]}, "key: found 'type'.*did you mean types?"),
        ({"fcd": "a.xml", "types": []}, r"types: found \(\), expected a list of one or more"),
        ({"fcd": "a.xml", "min_seconds": 0}, "min_seconds: found 0, expected a number > 0 or None"),
        ({"fcd": "a.xml", "shift_m": [1]}, r"shift_m: found \[1\], expected \[x, y\]"),
        ({"fcd": 3}, "fcd: found 3, expected str"),
    ],
)
def test_what_is_wrong_in_a_json_file_is_named(tmp_path, content, message):
    path = tmp_path / "traffic.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=f"traffic.json: not a traffic file: {message}"):
        task_from(scenario=path)


def test_one_trip_is_drawn_as_the_trajectory_it_is():
    """Windows of a single way are drawn as they always were."""
    trip = TRIPS["pedestrian1"]
    place = np.pad(trip.position_m + [20.0, -140.0], [(0, 0), (0, 1)], constant_values=1.5)
    one = source_of(Trajectory("mine", trip.time_s, place), epochs=20)
    other = source_of(few(ids=("pedestrian1",), shift_m=(20.0, -140.0)), epochs=20)
    for seed in range(3):
        a, b = (s.sample(np.random.default_rng(seed)) for s in (one, other))
        np.testing.assert_array_equal(a.truth_position_m, b.truth_position_m)
        np.testing.assert_array_equal(a.measurement, b.measurement)
