"""Tests of reading DeepMIMO recordings: anchors, paths, times, velocities, damaged folders."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.deepmimo import read_deepmimo
from mmwave_env.models.layout import wrapped
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.scene import Scene, Wall
from tests.datasets.deepmimo.scenarios import (
    LINK,
    OF_PATHS,
    PEDESTRIAN,
    TRUTH,
    VEHICLE,
    assert_fits,
    edit,
    edit_line,
    edit_params,
    load,
    reflect,
    set_at,
    set_counts,
    write_hall,
)
from tests.refusals import refuses

SCENE = Scene("canyon", (-5.0, 4.0, 6.0), (Wall((0, 1), 9.571564), Wall((0, 1), -8.613335)))


@pytest.fixture
def folder(tmp_path):
    """Return a copy of the vehicle scenario, which tests may damage."""
    return Path(shutil.copytree(VEHICLE, tmp_path / "scenario"))


@pytest.mark.parametrize(
    ("source", "counts"), [(VEHICLE, (120, 111, 69, 120)), (PEDESTRIAN, (400, 400, 256, 400))]
)
def test_virtual_anchors_are_the_gnb_mirrored_in_the_walls_and_every_row_fits_them(source, counts):
    recording = read_deepmimo(source)
    anchors = [(-5.0, 4.0, 6.0), (-5.0, 15.1431, 6.0), (-5.0, -21.2266, 6.0)]
    assert_allclose(recording.anchors_m, anchors, atol=1e-4)
    assert tuple(recording.visible.sum(axis=0)) == counts
    assert recording.name == source.name
    assert recording.scene.carrier_hz == 28e9
    assert recording.scene.bandwidth_hz == 100e6
    strongest = np.nanmax(load(source, "power"), axis=1)
    assert_allclose(recording.path_gain_db[:, 0], strongest)
    assert_fits(recording, SCENE, 1e-4, 2e-5)


@pytest.mark.parametrize(("wanted", "images"), [(0, 0), (1, 1), (2, 2), (9, 2)])
def test_the_mirror_images_that_are_visible_most_often_are_kept(wanted, images):
    recording = read_deepmimo(VEHICLE, virtual_anchors=wanted)
    assert_allclose(recording.anchors_m, SCENE.anchors_m[: 1 + images], atol=1e-4)
    assert recording.layout.anchors == 1 + images


def test_a_negative_number_of_virtual_anchors_is_refused():
    with refuses("virtual_anchors"):
        read_deepmimo(VEHICLE, virtual_anchors=-1)


@pytest.mark.parametrize("kind", ["aoa", "aod"])
def test_directions_may_point_along_or_against_the_propagation(folder, kind):
    expected = read_deepmimo(folder)
    edit(folder, f"{kind}_az", lambda degrees: degrees + 180.0)
    edit(folder, f"{kind}_el", lambda degrees: 180.0 - degrees)
    again = read_deepmimo(folder)
    angles = expected.layout.angles
    difference = again.measurement[:, angles] - expected.measurement[:, angles]
    assert np.nanmax(abs(wrapped(difference))) < 1e-5


def test_the_strongest_of_several_paths_to_an_anchor_is_used(folder):
    expected = read_deepmimo(folder)
    for key in OF_PATHS:
        edit(folder, key, lambda array: np.concatenate([array, array], axis=1))

    def weaken(power):
        power[:60, :4] -= 3.0
        power[60:, 4:] -= 3.0

    edit(folder, "power", weaken)
    edit(folder, "delay", lambda delay: np.add(delay, [0] * 4 + [1e-10] * 4))
    again = read_deepmimo(folder)
    late_m = np.where(np.arange(120) < 60, SPEED_OF_LIGHT * 1e-10, 0.0)
    assert_allclose(again.measurement[:, 0] - expected.measurement[:, 0], late_m, atol=1e-5)
    assert_array_equal(again.path_gain_db[:, 0], expected.path_gain_db[:, 0])


def test_scattered_paths_are_left_out(folder):
    def scatter(inter):
        inter[:40][inter[:40] == 1.0] = 3.0

    edit(folder, "inter", scatter)
    recording = read_deepmimo(folder)
    assert recording.visible[:, 0].all()
    assert not recording.visible[:40, 1:3].any()
    assert recording.visible[40:, 1].any()


@settings(max_examples=30)
@given(
    turn=st.floats(0.0, 2.0 * np.pi),
    offset=st.floats(5.0, 100.0),
    tilt=st.floats(-0.3, 0.3),
    height=st.floats(3.0, 30.0),
    course=st.floats(0.0, 2.0 * np.pi),
)
def test_a_wall_in_any_direction_becomes_an_anchor(turn, offset, tilt, height, course):
    gnb = np.array([0.0, 0.0, height])
    normal = np.array([np.cos(turn), np.sin(turn), tilt])
    normal /= np.linalg.norm(normal)
    # Users are on the gNB's side of the wall, at least four meters away from the wall.
    along = np.array([np.cos(course), np.sin(course), 0.0])
    users = np.array([3.0, -2.0, 1.5]) + np.linspace(-30.0, 30.0, 7)[:, None] * along
    distance = max(offset, gnb @ normal + 4.0, float((users @ normal).max()) + 4.0)
    with tempfile.TemporaryDirectory() as name:
        write_hall(Path(name), gnb, users, [(normal, distance)])
        recording = read_deepmimo(name, virtual_anchors=1)
    assert_allclose(recording.anchors_m, [gnb, reflect(gnb, normal, distance)], atol=1e-6)
    assert recording.visible.all()
    assert_fits(recording, recording.scene)


def drop(folder, file):
    (folder / file).unlink()


def write(folder, file, content):
    (folder / file).write_bytes(content)


USER = (-45.0, -2.0, 1.5)  # first position of the user
# name -> (function that damages a folder, its other arguments, file or part named in the refusal)
DAMAGE = {
    "no params": (drop, ["params.json"], "params.json"),
    "params that are not JSON": (write, ["params.json", b"{"], "params.json"),
    "a word as frequency": (
        edit_params,
        [lambda p: p["rt_params"].update(frequency="28 GHz")],
        "rt_params.frequency",
    ),
    "dynamic scenario": (set_counts, [120, 7], "scene.num_scenes"),
    "no file of receivers": (drop, [f"rx_pos_{LINK}.npz"], "scenario"),
    "no delays": (drop, [f"delay_{LINK}.npz"], f"delay_{LINK}.npz"),
    "another key": (lambda f: np.savez(f / f"delay_{LINK}.npz", toa=load(f, "delay")), [], "delay"),
    "one path too few": (edit, ["aoa_az", lambda a: a[:, :3]], "aoa_az"),
    "a receiver at NaN": (edit, ["rx_pos", set_at((3, 1), np.nan)], "rx_pos[3, 1]"),
    "delay missing on a path": (edit, ["delay", set_at((5, 0), np.nan)], "delay[5, 0]"),
    "bounce at the receiver": (edit, ["inter_pos", set_at((0, 1, 0), USER)], "inter_pos"),
    "no interactions stored": (edit, ["inter_pos", lambda a: a[:, :, :0]], "inter_pos[0, 1, 0]"),
    "no line of sight": (edit, ["inter", lambda a: np.where(a == 0.0, 11.0, a)], "inter"),
    "no trajectory": (drop, [TRUTH], TRUTH),
    "other columns": (edit_line, [1, "t,x,y,z,vx,vy,w"], "header"),
    "one row too few": (edit_line, [50, None], "rows"),
    "a position elsewhere": (edit_line, [2, "0,-45,-3,1.5,10,0,0"], "line 2, columns x, y, z"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_the_error_about_damage_names_its_place(folder, damage):
    spoil, arguments, part = DAMAGE[damage]
    spoil(folder, *arguments)
    with refuses(folder, part, error=(ValueError, FileNotFoundError)):
        read_deepmimo(folder)


def test_the_error_about_a_wrong_path_names_path_and_receiver(folder):
    edit(folder, "delay", set_at((7, 0), 1.0))
    with pytest.raises(ValueError, match="on path 0 of receiver 7,"):
        read_deepmimo(folder, users=[3, 7], dt_s=1.0)


def test_a_path_that_is_not_a_folder_is_refused(tmp_path):
    for path in (tmp_path / "nowhere", Path(__file__)):
        with refuses(path, error=FileNotFoundError):
            read_deepmimo(path)


# --- times and velocities, from dt_s or from the sidecar (the file trajectory.csv)


def test_missing_velocities_are_computed_from_positions_and_missing_times_from_dt_s(folder):
    expected = read_deepmimo(folder)
    lines = (folder / TRUTH).read_text().splitlines()
    (folder / TRUTH).write_text("\n".join(",".join(line.split(",")[:4]) for line in lines))
    recording = read_deepmimo(folder)
    assert_array_equal(recording.measurement[:, :12], expected.measurement[:, :12])
    assert_allclose(recording.velocity_mps, expected.velocity_mps, atol=0.06)
    (folder / TRUTH).unlink()
    recording = read_deepmimo(folder, dt_s=0.1)
    assert_allclose(recording.time_s, expected.time_s, atol=1e-9)
    assert_array_equal(recording.position_m, load(folder, "rx_pos"))
    assert_allclose(recording.velocity_mps, expected.velocity_mps, atol=0.06)
    shifts_hz = recording.measurement[:, -1], expected.measurement[:, -1]
    assert_allclose(*shifts_hz, atol=5.0)


@pytest.mark.parametrize("dt_s", [0.0, float("nan")])
def test_an_impossible_time_between_epochs_is_refused(folder, dt_s):
    with refuses("dt_s"):
        read_deepmimo(folder, dt_s=dt_s)


def test_impossible_speeds_and_time_steps_are_refused_without_a_sidecar(folder):
    with refuses(folder, "row 2: t"):
        read_deepmimo(folder, dt_s=100.0)  # meant as 100 ms, but dt_s is in seconds
    edit(folder, "rx_pos", lambda a: np.where(np.arange(120)[:, None] < 9, a, a + 50.0))
    with refuses(folder, "row 10: speed"):
        read_deepmimo(folder, dt_s=0.1)
