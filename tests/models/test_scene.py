"""Tests of scenes: mirror images, the shipped streets, scene files, and random scenes."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene, scenes_from
from mmwave_env.models.scene import (
    SCENES,
    LearnedImage,
    Scene,
    Streets,
    Wall,
    scene_from,
    scene_json,
)
from mmwave_env.world.keys import keys_of
from mmwave_env.world.mobility import MOBILITIES
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import around_a_block
from tests.paths import write_json
from tests.refusals import refuses

coordinates = st.floats(-1e3, 1e3, allow_subnormal=False)
points = st.tuples(coordinates, coordinates, coordinates)
normals = st.tuples(coordinates, coordinates).filter(lambda n: np.hypot(*n) > 1e-2)
walls = st.builds(Wall, normals, coordinates)

MINIMAL = {"base_station_m": [10, 10, 10]}
# positions of anchors
HERE = (1.0, 2.0, 3.0)
THERE = (4.0, 5.0, 6.0)


@settings(derandomize=True)
@given(walls, st.sampled_from([1, -1]), *[st.floats(0.1, 500.0)] * 2, points, points)
def test_a_reflection_is_as_long_as_the_line_from_the_mirror_image(
    wall, side, d_source, d_user, a, b
):
    # Source and user are d_source and d_user from the wall, on the same side. The point of
    # reflection divides the line between their projections onto the wall in the ratio of these
    # distances.
    normal = np.array([*wall.normal, 0.0]) / np.hypot(*wall.normal)
    on_wall = [p - (p @ normal - wall.offset_m) * normal for p in (np.array(a), np.array(b))]
    source = on_wall[0] + side * d_source * normal
    user = on_wall[1] + side * d_user * normal
    specular = (d_user * on_wall[0] + d_source * on_wall[1]) / (d_source + d_user)
    path = np.linalg.norm(source - specular) + np.linalg.norm(specular - user)
    image = np.array(wall.mirror(tuple(source)))
    assert np.linalg.norm(user - image) == pytest.approx(path, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "base_station", "width_m", "length_m", "user_height_m"),
    [
        ("o1", (235.504, 489.504, 6.0), 0.0, 600.0, 2.0),
        ("dynamic-doppler", (7.0, 14.0, 4.5), 430.0, 0.0, 1.5),
    ],
)
def test_public_reference_scenes_have_their_documented_geometry(
    name, base_station, width_m, length_m, user_height_m
):
    scene = scene_from(name)
    assert scene.base_station_m == base_station
    assert np.ptp(scene.streets.x_m) == width_m and np.ptp(scene.streets.y_m) == length_m
    assert scene.streets.height_m == user_height_m
    assert scene.carrier_hz == 28e9 and len(scene.anchors_m) == 3


def test_a_scene_file_may_leave_out_everything_except_the_base_station(tmp_path):
    path = write_json(tmp_path / "plaza.json", MINIMAL)
    assert scene_from(path) == Scene("plaza", (10.0, 10.0, 10.0))


ANCHORS = {"anchors": [[10, 10, 10], [10, 40, 10]], "carrier_hz": 28e9, "bandwidth_hz": 1e8}


def test_a_scene_file_may_list_anchors(tmp_path):
    path = write_json(tmp_path / "plaza.json", ANCHORS | {"carrier_hz": 39e9})
    fields = {"virtual_anchors_m": ((10.0, 40.0, 10.0),), "carrier_hz": 39e9, "bandwidth_hz": 1e8}
    assert scene_from(path) == Scene("plaza", (10.0, 10.0, 10.0), **fields)


def test_surveyed_virtual_anchors_are_listed_after_mirror_images():
    scene = replace(SCENES["street"], virtual_anchors_m=(HERE, THERE))
    np.testing.assert_allclose(
        scene.anchors_m, [[10, 10, 10], [10, 40, 10], [360, 10, 10], [1, 2, 3], [4, 5, 6]]
    )


# corrections of a log's frame and ranges
CORRECTED = {"bearing_deg": 2.5, "range_offset_m": (1.0, -2.0), "range_offset_sigma_m": (0.1, 0.2)}
LEARNED = (LearnedImage((0.1, 0.2, 0.3), 42),)
IMAGE = {"virtual_anchors_m": (THERE,), "learned": LEARNED}


@pytest.mark.parametrize(
    "scene",
    [
        *SCENES.values(),
        replace(SCENES["o1"], name="both", virtual_anchors_m=(HERE,)),
        Scene("surveyed", HERE, virtual_anchors_m=(THERE,)),
        Scene("alone", HERE, (), Streets(y_m=(0.0, 80.0)), 39e9, 4e8),
        replace(SCENES["street"], name="learned", **IMAGE),
        Scene("learned and corrected", HERE, **IMAGE, **CORRECTED),
        Scene("corrected", HERE, (Wall((0.0, 1.0), 25.0),), **CORRECTED),
    ],
    ids=lambda scene: scene.name,
)
def test_a_written_scene_reads_back_equal(tmp_path, scene):
    written = scene_json(scene)
    assert scene_from(write_json(tmp_path / "plaza.json", written)) == scene
    assert ("anchors" in written) == (not scene.walls)
    for key in (*CORRECTED, "learned"):
        assert (key in written) == bool(getattr(scene, key))
    offsets = list(scene.range_offset_m) or [0.0] * len(scene.anchors_m)
    assert scene.offsets_m.tolist() == offsets


@pytest.mark.parametrize(
    ("content", "field"),
    [
        ({"anchors": ANCHORS["anchors"]}, "carrier_hz"),
        (MINIMAL | {"walls": [{"normal": [0, 0], "offset_m": 25}]}, "normal"),
        (MINIMAL | {"streets": {"x_m": [0, 100], "block_m": 80}}, "x_m"),
        (ANCHORS | {"base_station_m": [0, 0, 0]}, "plaza.json"),
        (ANCHORS | {"anchors": [[0, 0, 0], [1, 2]]}, "anchors[1]"),
        ({"walls": []}, "plaza.json"),
        (ANCHORS | {"bearing_deg": 400.0}, "bearing_deg"),
        (ANCHORS | {"range_offset_m": [1.0]}, "range_offset_m"),
        (ANCHORS | {"range_offset_m": [1.0, 2.0, 3.0]}, "range_offset_m"),
        (ANCHORS | {"range_offset_sigma_m": [0.1]}, "range_offset_sigma_m"),
        (ANCHORS | {"range_offset_sigma_m": [-0.1, 0.1]}, "range_offset_sigma_m"),
    ],
    ids=repr,
)
def test_a_damaged_scene_file_is_refused_with_the_name_of_the_field(tmp_path, content, field):
    path = write_json(tmp_path / "plaza.json", content)
    with refuses(path, field):
        scene_from(path)


def test_an_unknown_scene_is_told_that_files_exist_too():
    with pytest.raises(ValueError, match="json file"):
        scenes_from("market.jsn")


def test_impossible_scenes_are_refused():
    with refuses("y_m"):
        Streets(y_m=(0.0, -160.0))
    with refuses("streets of scene 'odd'"):
        Scene("odd", (10.0, 10.0, 10.0), (Wall((0, 1), -50.0),)).require_streets_in_front()


SOURCE = SimulatedSource(RandomScene(), RADIOS["handset"])


@pytest.fixture(scope="module")
def drawn():
    """Return 2000 random scenes."""
    return [SOURCE.scene_of(int(key)) for key in keys_of(range(2000))]


def test_random_scenes_fill_their_ranges(drawn):
    ranges = RandomScene()
    block = np.array([scene.streets.block_m for scene in drawn])
    height = np.array([scene.base_station_m[2] for scene in drawn])
    for values, (low, high) in ((block, ranges.block_m), (height, ranges.height_m)):
        assert low <= values.min() and values.max() <= high
        margin = 0.02 * (high - low)
        assert values.min() < low + margin and values.max() > high - margin
    extents = [(np.ptp(scene.streets.x_m), np.ptp(scene.streets.y_m)) for scene in drawn]
    blocks = set(map(tuple, np.round(np.array(extents) / block[:, None]).astype(int).tolist()))
    assert blocks == {(x, y) for x in range(4) for y in range(4)} - {(0, 0)}
    sides = {tuple(wall.offset_m > 0.0 for wall in scene.walls) for scene in drawn}
    assert len(sides) == 4


def test_a_random_base_station_is_near_a_crossing_and_walls_are_behind_everything_else(drawn):
    ranges = RandomScene()
    for scene in drawn:
        scene.require_streets_in_front()
        assert len(scene.anchors_m) == 3
        block = scene.streets.block_m
        base = np.array(scene.base_station_m[:2])
        ends = np.array([scene.streets.x_m[1], scene.streets.y_m[1]])
        crossing = np.clip(np.round(base / block) * block, 0.0, ends)
        beside = np.abs(base - crossing)
        assert (ranges.beside_m[0] - 1e-9 <= beside).all()
        assert (beside <= ranges.beside_m[1] + 1e-9).all()
        for axis, wall in enumerate(scene.walls):
            lowest = min(0.0, base[axis])
            highest = max(ends[axis], base[axis])
            behind = wall.offset_m - highest if wall.offset_m > 0.0 else lowest - wall.offset_m
            assert ranges.behind_m[0] - 1e-9 <= behind <= ranges.behind_m[1] + 1e-9


@pytest.mark.parametrize(
    ("field", "value"), [("block_m", (0.0, 80.0)), ("height_m", (9.0, 8.0)), ("blocks", 0)]
)
def test_impossible_ranges_are_refused(field, value):
    with refuses(field):
        RandomScene(**{field: value})


def test_a_corner_radius_that_does_not_fit_the_closest_streets_is_refused():
    tight = RandomScene(block_m=(10.0, 140.0))
    with refuses("corner_radius_m of mobility 'vehicle'"):
        gym.make("mmwave_env:MmWaveLoc-v0", scene=tight, scenario=MOBILITIES["vehicle"])


def test_a_given_trajectory_in_random_scenes_is_refused():
    with refuses("scene"):
        gym.make("mmwave_env:MmWaveLoc-v0", scene="random", scenario=around_a_block())


def test_a_scene_with_other_anchors_has_no_walls():
    anchors = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    moved = SCENES["street"].with_anchors(anchors)
    assert moved.anchors_m.tolist() == anchors.tolist() and moved.walls == ()


def test_more_learned_images_than_virtual_anchors_are_refused():
    with refuses("learned"):
        replace(SCENES["street"], learned=LEARNED)
