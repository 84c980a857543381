"""Tests of examples that make data: ways (tracks) with SUMO, DeepMIMO folders by ray tracing."""

import gzip
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from runpy import run_path
from types import SimpleNamespace

import numpy as np
import pytest

from mmwave_env.datasets.deepmimo import read_deepmimo
from mmwave_env.datasets.ways import read_ways
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.scene import SCENES
from mmwave_env.task import task_from
from tests.cli import environment
from tests.paths import RECORDINGS, ROOT


def loaded(name):
    return SimpleNamespace(**run_path(str(ROOT / "examples" / f"{name}.py")))


def run(name, *options, cwd):
    words = [sys.executable, ROOT / "examples" / f"{name}.py", *map(str, options)]
    done = subprocess.run(words, cwd=cwd, env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("name", ["raytrace", "sumo"])
def test_an_example_that_makes_data_is_short(name):
    assert len((ROOT / "examples" / f"{name}.py").read_text("utf-8").splitlines()) <= 120


# --- SUMO


PERSON = '<vehicle id="walker"', '<person id="walker"'


def write_traffic(path):
    """Write a file as `sumo --fcd-output` does: a car, a pedestrian, and trips to be left out."""
    steps = []
    for t in range(91):
        users = {"car": (60 + t, 100), "walker": (60, 30 + t), "lost": (60 + t, 100 + 2 * t)}
        users |= {"brief": (t, 9)} if t < 20 else {}
        rows = [f'<vehicle id="{i}" x="{x}" y="{y}" speed="1.0"/>' for i, (x, y) in users.items()]
        steps.append(f'<timestep time="{t}.00">{"".join(rows)}</timestep>'.replace(*PERSON))
    content = f"<?xml version='1.0'?>\n<fcd-export>{''.join(steps)}</fcd-export>\n".encode()
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)


@pytest.mark.parametrize("name", ["traffic.xml", "traffic.xml.gz"])
def test_trips_become_ways_from_which_episodes_are_drawn(tmp_path, name):
    write_traffic(tmp_path / name)
    text = run("sumo", name, "ways.csv", "--shift", 0, -140, cwd=tmp_path)
    for part in (
        "4 trips",
        "left out: lost, row 34",
        "1 trips left out",
        "2 ways written to ways.csv",
    ):
        assert part in text
    car, walker = read_ways(tmp_path / "ways.csv").trajectories
    np.testing.assert_array_equal(car.time_s, np.arange(91.0))
    np.testing.assert_array_equal(car.position_m[[0, -1]], [[60, -40, 1.5], [150, -40, 1.5]])
    source = task_from(scenario=tmp_path / "ways.csv", episode_steps=60).source
    names = {source.sample(np.random.default_rng(seed)).name for seed in range(9)}
    assert names == {car.name, walker.name}


def test_the_traffic_is_moved_to_the_middle_of_the_street(tmp_path, capsys):
    write_traffic(tmp_path / "traffic.xml")
    sumo, street = loaded("sumo"), SCENES["street"]
    sumo.ways_in(street, sumo.read_trips(tmp_path / "traffic.xml"), 60.0)
    assert "moved by (5.0, -224.5) m" in capsys.readouterr().out  # x 0..150, y 9..280


@pytest.mark.slow
def test_sumo_makes_traffic(tmp_path):
    try:
        distribution("eclipse-sumo")
    except PackageNotFoundError:
        pytest.skip("needs examples/sumo.txt")
    run("sumo", "--make", 120, "town.xml.gz", "ways.csv", "--least", 40, cwd=tmp_path)
    assert len(read_ways(tmp_path / "ways.csv").trajectories) > 9


# --- ray tracing

STATION, WALL_Y = np.array([-5.0, 4.0, 6.0]), 10.0
USERS = np.column_stack([np.linspace(0.0, 20.0, 21), np.full(21, -2.0), np.full(21, 1.5)])


def sionna_paths(users_m, hidden=()):
    """Return the parts of Sionna RT's paths that the example reads, for a street with one wall.

    Axes are [receiver, transmitter, path]; arrays of interactions have a depth axis before these.
    The line of sight is the second path, and hidden receivers have none.
    """
    image = STATION * [1, -1, 1] + [0, 2 * WALL_Y, 0]
    share = (WALL_Y - users_m[:, 1]) / (image[1] - users_m[:, 1])
    bounce = users_m + share[:, None] * (image - users_m)
    station = np.broadcast_to(STATION, users_m.shape)
    aim_r = np.stack([bounce, station], axis=1) - users_m[:, None]
    aim_t = np.stack([bounce, users_m], axis=1) - STATION
    length = np.linalg.norm(np.stack([image - users_m, STATION - users_m], axis=1), axis=-1)
    valid = np.ones((len(users_m), 1, 2), bool)
    valid[list(hidden), 0, 1] = False
    angles = {}
    for end, aim in (("r", aim_r), ("t", aim_t)):
        x, y, z = np.moveaxis(aim, -1, 0)
        angles[f"phi_{end}"] = np.arctan2(y, x)[:, None]
        angles[f"theta_{end}"] = np.arctan2(np.hypot(x, y), z)[:, None]
    gain = (1e-3 / length)[:, None, None, None]
    vertices = np.stack([bounce, np.zeros_like(bounce)], axis=1)[:, None]
    kinds = np.broadcast_to([1, 0], (1, len(users_m), 1, 2))
    tau = (length / SPEED_OF_LIGHT)[:, None]
    paths = {"a": (gain, 0.0 * gain), "tau": tau, "valid": valid, "vertices": vertices[None]}
    return SimpleNamespace(interactions=kinds, **paths, **angles)


def test_traced_paths_are_written_to_a_folder_and_read_back(tmp_path):
    """Use arrays shaped as in Sionna RT 2.2; the next test runs its solver if it is installed."""
    raytrace, velocity = loaded("raytrace"), np.tile([10.0, 0.0, 0.0], (21, 1))
    traced = sionna_paths(USERS[:12], hidden=[3]), sionna_paths(USERS[12:])
    blocks = [raytrace.arrays_of(paths) for paths in traced]
    arrays = {key: raytrace.joined([block[key] for block in blocks]) for key in blocks[0]}
    track = np.hstack([USERS, velocity])
    raytrace.write_folder(tmp_path / "way", arrays, 28e9, STATION, 0.1 * np.arange(21), track)
    recording = read_deepmimo(tmp_path / "way")
    np.testing.assert_allclose(recording.anchors_m, [STATION, [-5.0, 16.0, 6.0]], atol=1e-4)
    assert recording.visible[:, 0].tolist() == [row != 3 for row in range(21)]
    assert recording.visible[:, 1].all()
    np.testing.assert_array_equal(recording.velocity_mps, velocity)
    direct = np.linalg.norm(USERS - STATION, axis=1)
    sight = recording.visible[:, 0]
    np.testing.assert_allclose(recording.measurement[sight, 0], direct[sight], atol=1e-4)
    loss = 20.0 * np.log10(1e-3 / direct[sight])
    np.testing.assert_allclose(recording.path_gain_db[sight, 0], loss, atol=1e-4)
    assert len(task_from(episodes=tmp_path / "way").source.sample(np.random.default_rng(0))) == 21


@pytest.mark.slow
def test_tracing_a_shipped_recording_again_gives_the_same_measurements(tmp_path):
    pytest.importorskip("sionna.rt", reason="needs examples/raytrace.txt")
    shipped = RECORDINGS / "canyon28_walk_ride_walk"
    run("raytrace", shipped / "trajectory.csv", tmp_path / "again", cwd=tmp_path)
    again, expected = read_deepmimo(tmp_path / "again"), read_deepmimo(shipped)
    np.testing.assert_array_equal(again.visible, expected.visible)
    rows = np.repeat(expected.visible, [4, 4, 4, 1], axis=1)
    np.testing.assert_allclose(again.measurement[rows], expected.measurement[rows], atol=1e-4)
