"""Scenes: mirror images, the shipped streets, and scenes from files."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.models.scene import SCENES, Scene, Streets, Wall, scene_from, scene_json

coordinates = st.floats(-1e3, 1e3, allow_subnormal=False)
points = st.tuples(coordinates, coordinates, coordinates)
normals = st.tuples(coordinates, coordinates).filter(lambda n: np.hypot(*n) > 1e-2)
walls = st.builds(Wall, normals, coordinates)

MINIMAL = {"base_station_m": [10, 10, 10]}


def write(folder, content):
    path = folder / "plaza.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@settings(derandomize=True, deadline=None)
@given(walls, points)
def test_mirroring_twice_is_the_identity(wall, point):
    assert wall.mirror(wall.mirror(point)) == pytest.approx(point, rel=1e-9, abs=1e-8)


@settings(derandomize=True, deadline=None)
@given(walls, st.floats(0.1, 500.0), st.floats(0.1, 500.0), points, points)
def test_a_reflection_is_as_long_as_the_line_from_the_mirror_image(wall, ahead, behind, a, b):
    # Source and user at distances `ahead` and `behind` before the wall, anywhere along it; the
    # specular point divides the way along the wall in the ratio of the distances.
    normal = np.array([*wall.normal, 0.0]) / np.hypot(*wall.normal)
    on_wall = [p - (p @ normal - wall.offset_m) * normal for p in (np.array(a), np.array(b))]
    source, user = on_wall[0] + ahead * normal, on_wall[1] + behind * normal
    specular = (behind * on_wall[0] + ahead * on_wall[1]) / (ahead + behind)
    path = np.linalg.norm(source - specular) + np.linalg.norm(specular - user)
    image = np.array(wall.mirror(tuple(source)))
    assert np.linalg.norm(user - image) == pytest.approx(path, rel=1e-9)


@pytest.mark.parametrize(
    ("wall", "side"),
    [
        (Wall((0, 1), 25.0), "y below 25 m"),
        (Wall((0, -2), -25.0), "y below 25 m"),
        (Wall((1, 0), -5.0), "x above -5 m"),
        (Wall((3, 4), 20.0), "0.6 x +0.8 y below 20 m"),
    ],
)
def test_a_wall_says_on_which_side_a_point_is(wall, side):
    assert wall.side_of((10.0, 10.0, 10.0)) == side


def test_anchors_of_the_default_street():
    np.testing.assert_allclose(
        SCENES["street"].anchors_m, [[10, 10, 10], [10, 40, 10], [360, 10, 10]], atol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "base_station", "width_m", "length_m", "user_height_m"),
    [("o1", (235.504, 489.504, 6.0), 0.0, 600.0, 2.0),
     ("dynamic-doppler", (7.0, 14.0, 4.5), 430.0, 0.0, 1.5)],
)  # fmt: skip
def test_public_reference_scenes(name, base_station, width_m, length_m, user_height_m):
    scene = scene_from(name)
    assert scene.base_station_m == base_station
    assert np.ptp(scene.streets.x_m) == width_m and np.ptp(scene.streets.y_m) == length_m
    assert scene.streets.height_m == user_height_m
    assert scene.carrier_hz == 28e9 and len(scene.anchors_m) == 3


def test_doppler_scale_is_carrier_over_speed_of_light():
    assert Scene("a", (0, 0, 0), carrier_hz=28e9).hz_per_mps == pytest.approx(28e9 / 299_792_458)


def test_unknown_scene_lists_the_valid_ones():
    with pytest.raises(ValueError, match="'plaza'.*street, o1, dynamic-doppler"):
        scene_from("plaza")


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_survives_a_file(tmp_path, name):
    scene = SCENES[name]
    assert scene_from(write(tmp_path, asdict(scene))) == scene
    assert scene_from(str(write(tmp_path, asdict(scene)))) == scene


def test_a_scene_file_may_leave_out_all_but_the_base_station(tmp_path):
    assert scene_from(write(tmp_path, MINIMAL)) == Scene("plaza", (10.0, 10.0, 10.0))


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        "null",
        {},
        {"base_station_m": 10},
        {"base_station_m": [10, 10]},
        {"base_station_m": [10, 10, 10, 10]},
        {"base_station_m": [10, 10, "high"]},
        {"base_station_m": [10, 10, float("nan")]},
        MINIMAL | {"walls": {"normal": [0, 1], "offset_m": 25}},
        MINIMAL | {"walls": [{"normal": [0, 1]}]},
        MINIMAL | {"walls": [{"normal": [0, 0], "offset_m": 25}]},
        MINIMAL | {"walls": [{"normal": [0, 1, 0], "offset_m": 25}]},
        MINIMAL | {"walls": [{"normal": [0, 1], "offset_m": float("nan")}]},
        MINIMAL | {"streets": {"x_m": [160, 0]}},
        MINIMAL | {"streets": {"x_m": [0]}},
        MINIMAL | {"streets": {"x_m": "ab"}},
        MINIMAL | {"streets": {"block_m": 0}},
        MINIMAL | {"streets": {"x_m": [0, 100], "block_m": 80}},
        MINIMAL | {"streets": {"height_m": "tall"}},
        MINIMAL | {"streets": {"lanes": 2}},
        MINIMAL | {"carrier_hz": -28e9},
        MINIMAL | {"bandwidth_hz": "wide"},
        MINIMAL | {"color": "red"},
        MINIMAL | {"virtual_anchors_m": [[1, 2]]},
        MINIMAL | {"virtual_anchors_m": [1, 2, 3]},
        MINIMAL | {"virtual_anchors_m": 1},
    ],
    ids=lambda content: content if isinstance(content, str) else json.dumps(content),
)
def test_a_damaged_scene_file_is_refused_by_name(tmp_path, content):
    path = write(tmp_path, content)
    with pytest.raises(ValueError, match="plaza.json"):
        scene_from(path)


def test_a_scene_file_that_is_not_text_is_refused_by_name(tmp_path):
    path = tmp_path / "plaza.json"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="plaza.json"):
        scene_from(path)


def test_a_missing_scene_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="plaza.json"):
        scene_from(tmp_path / "plaza.json")


ANCHORS = {"anchors": [[10, 10, 10], [10, 40, 10]], "carrier_hz": 28e9, "bandwidth_hz": 1e8}


def without(content, key):
    return {k: v for k, v in content.items() if k != key}


def test_a_scene_file_may_list_anchors(tmp_path):
    scene = scene_from(write(tmp_path, ANCHORS | {"carrier_hz": 39e9}))
    assert scene.name == "plaza" and scene.walls == ()
    assert scene.base_station_m == (10.0, 10.0, 10.0)
    assert scene.virtual_anchors_m == ((10.0, 40.0, 10.0),)
    assert (scene.carrier_hz, scene.bandwidth_hz) == (39e9, 1e8)
    np.testing.assert_array_equal(scene.anchors_m, ANCHORS["anchors"])


def test_a_listed_anchor_is_as_good_as_a_mirror_image(tmp_path):
    listed = scene_from(write(tmp_path, ANCHORS | {"name": "listed"}))
    mirrored = Scene("mirrored", (10.0, 10.0, 10.0), (Wall((0, 1), 25.0),))
    assert listed.name == "listed"
    np.testing.assert_allclose(listed.anchors_m, mirrored.anchors_m, atol=1e-12)


def test_virtual_anchors_follow_the_mirror_images():
    scene = replace(SCENES["street"], virtual_anchors_m=((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)))
    np.testing.assert_allclose(
        scene.anchors_m, [[10, 10, 10], [10, 40, 10], [360, 10, 10], [1, 2, 3], [4, 5, 6]]
    )


@pytest.mark.parametrize(
    "scene",
    [
        *SCENES.values(),
        replace(SCENES["o1"], name="both", virtual_anchors_m=((1.0, 2.0, 3.0),)),
        Scene("surveyed", (1.0, 2.0, 3.0), virtual_anchors_m=((4.0, 5.0, 6.0),)),
        Scene("alone", (1.0, 2.0, 3.0), (), Streets(y_m=(0.0, 80.0)), 39e9, 4e8),
    ],
    ids=lambda scene: scene.name,
)
def test_a_written_scene_reads_back_equal(tmp_path, scene):
    written = scene_json(scene)
    assert scene_from(write(tmp_path, written)) == scene
    assert ("anchors" in written) == (not scene.walls)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (without(ANCHORS, "carrier_hz"), "carrier_hz: found none, expected one beside"),
        (without(ANCHORS, "bandwidth_hz"), "bandwidth_hz: found none, expected one beside"),
        (ANCHORS | {"base_station_m": [0, 0, 0]}, "anchors and base_station_m, expected either"),
        (ANCHORS | {"walls": []}, "anchors and walls, expected either"),
        (ANCHORS | {"color": 1}, "key: found 'color', expected one of name, anchors, carrier_hz"),
        (ANCHORS | {"anchors": []}, "anchors: found 0, expected a list of 1 to 32"),
        (ANCHORS | {"anchors": {}}, "anchors: found {}, expected a list"),
        (ANCHORS | {"anchors": [0, 0, 0]}, "anchors[0]: found 0, expected [x, y, z]"),
        (
            ANCHORS | {"anchors": [[0, 0, 0], [1, 2]]},
            "anchors[1]: found (1.0, 2.0), expected",
        ),
        (ANCHORS | {"anchors": [[0, 0, "a"]]}, "anchors[0]: found (0.0, 0.0, 'a'), expected"),
        (
            ANCHORS | {"anchors": [[0, 0, float("inf")]]},
            "anchors[0]: found (0.0, 0.0, inf)",
        ),
        (ANCHORS | {"carrier_hz": 0}, "carrier_hz: found 0.0, expected hertz, 1e6 to 2.9e12"),
        (ANCHORS | {"carrier_hz": float("nan")}, "carrier_hz: found nan"),
        (ANCHORS | {"carrier_hz": 28}, "carrier_hz: found 28.0, expected hertz, 1e6 to 2.9e12"),
        (
            ANCHORS | {"bandwidth_hz": 100},
            "found 100.0, expected hertz, 1e5 to 1e12",
        ),
        (ANCHORS | {"bandwidth_hz": "wide"}, "wide"),
        (MINIMAL | {"color": 1}, "key: found 'color', expected one of name, base_station_m"),
        ({"walls": []}, "found neither base_station_m nor anchors"),
        ([], "found list, expected an object"),
    ],
    ids=repr,
)
def test_a_damaged_scene_file_says_what_is_wrong(tmp_path, content, message):
    path = write(tmp_path, content)
    with pytest.raises(ValueError, match="plaza.json") as error:
        scene_from(path)
    assert str(error.value).startswith(f"{path}: ") and message in str(error.value)


def test_virtual_anchors_are_checked():
    with pytest.raises(ValueError, match=r"virtual_anchors_m\[1\]: found \(1.0, nan, 2.0\)"):
        Scene("odd", (0.0, 0.0, 0.0), virtual_anchors_m=((1.0, 2.0, 3.0), (1.0, np.nan, 2.0)))


def test_streets_refuse_extents_that_are_the_wrong_way_round():
    with pytest.raises(ValueError, match="y_m"):
        Streets(y_m=(0.0, -160.0))


@pytest.mark.parametrize("name", SCENES)
def test_users_of_the_shipped_scenes_stay_in_front_of_the_walls(name):
    SCENES[name].require_streets_in_front()


def test_streets_behind_a_wall_are_refused():
    scene = Scene("odd", (10.0, 10.0, 10.0), (Wall((0, 1), -50.0),))
    with pytest.raises(ValueError, match="streets of scene 'odd'.*all at y above -50 m, where"):
        scene.require_streets_in_front()
