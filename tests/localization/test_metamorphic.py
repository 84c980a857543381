"""The same street, told otherwise, gives the same track: no reference but the filters themselves.

Nobody knows the right track of a log; but a log whose scene is moved, turned or mirrored, whose
anchors are numbered otherwise, or whose columns are in other units has that track moved, turned or
mirrored with it, and the same uncertainty, NIS and gates.
"""

import gzip
from dataclasses import replace
from itertools import chain, permutations
from pathlib import Path

import numpy as np
import pytest

from mmwave_env.filters.bank import best_bank
from mmwave_env.filters.mode_files import named_modes
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import read_scene, scene_of_anchors
from tests.filters.tracks import TRIANGLE, assert_same_beliefs, unpacked
from tests.localization.mistakes import AZIMUTHS, FOLDERS, read_columns, write_columns

pytestmark = pytest.mark.slow  # all together half a minute

RADIO = RADIOS["standard"]
PIPELINES = {name: [mode] for name, mode in named_modes("standard").items()}
ROTATABLE = ["ekf", "ekf-robust"]  # sigma points lie along the axes of the map
ROUNDING = 1e-6  # in standard deviations
UNTURNED = np.eye(3)


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda folder: folder.name)
def street(request):
    """Columns of a recorded log, its first minute at most, and its scene."""
    columns = read_columns(request.param / "log.csv")
    first = columns["time_s"] < 15.0
    scene = read_scene(request.param / "scene.json")
    return {name: values[first] for name, values in columns.items()}, scene


def with_anchors(scene, anchors_m):
    return scene_of_anchors(scene.name, anchors_m, scene.carrier_hz, scene.bandwidth_hz)


def joined(blocks):
    """Every value of a track by its name, epochs along the first axis."""
    blocks = list(blocks)
    return {
        name: np.concatenate([getattr(block, name) for block in blocks])
        for name in blocks[0].per_epoch
    }


def located(log: Path, scene, modes):
    return joined(localize(read_log(log, scene), scene, RADIO, modes))


def track_of(folder, columns, scene, modes):
    write_columns(folder / "log.csv", columns)
    return located(folder / "log.csv", scene, modes)


def assert_moved(found, plain, turn=UNTURNED, shift_m=(0.0, 0.0, 0.0)):
    """Beliefs are those of ``plain`` turned by a matrix (3, 3), then shifted; gates agree."""
    whole = np.eye(7)
    whole[:3, :3] = whole[3:6, 3:6] = turn
    for x, P in (("x", "P"), ("x_predicted", "P_predicted"), ("smooth_x", "smooth_P")):
        expected = plain[x] @ whole.T + [*shift_m, 0.0, 0.0, 0.0, 0.0]
        covariance = whole @ unpacked(plain[P]) @ whole.T
        packed = covariance[..., TRIANGLE[0], TRIANGLE[1]]
        ours, theirs = {"x": found[x], "P": found[P]}, {"x": expected, "P": packed}
        assert_same_beliefs(ours, theirs, rtol=ROUNDING)
    np.testing.assert_allclose(found["nis"], plain["nis"], rtol=1e-6, atol=1e-6)
    for name in ("visible", "accepted", "incomplete", "mode"):
        np.testing.assert_array_equal(found[name], plain[name], err_msg=name)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_a_scene_elsewhere_gives_the_track_there(street, tmp_path, pipeline):
    (columns, scene), modes = street, PIPELINES[pipeline]
    shift_m = np.array([812.5, -4_096.25, 37.0])
    there = with_anchors(scene, scene.anchors_m + shift_m)
    plain = track_of(tmp_path, columns, scene, modes)
    assert_moved(track_of(tmp_path, columns, there, modes), plain, shift_m=shift_m)


@pytest.mark.parametrize("pipeline", ROTATABLE)
@pytest.mark.parametrize("angle", [0.5 * np.pi, np.pi, -2.0, 0.3])
def test_a_turned_scene_gives_the_turned_track(street, tmp_path, pipeline, angle):
    (columns, scene), modes = street, PIPELINES[pipeline]
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned = columns | {name: columns[name] + angle for name in AZIMUTHS}
    there = with_anchors(scene, scene.anchors_m @ turn.T)
    plain = track_of(tmp_path, columns, scene, modes)
    assert_moved(track_of(tmp_path, turned, there, modes), plain, turn)


@pytest.mark.parametrize("pipeline", PIPELINES)
@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
def test_a_mirrored_scene_gives_the_mirrored_track(street, tmp_path, pipeline, axis):
    (columns, scene), modes = street, PIPELINES[pipeline]
    turn = np.diag([-1.0 if i == axis else 1.0 for i in range(3)])
    offset = np.pi if axis == 0 else 0.0
    mirrored = columns | {name: offset - columns[name] for name in AZIMUTHS}
    there = with_anchors(scene, scene.anchors_m @ turn)
    plain = track_of(tmp_path, columns, scene, modes)
    assert_moved(track_of(tmp_path, mirrored, there, modes), plain, turn)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_virtual_anchors_have_no_order(street, tmp_path, pipeline):
    (columns, scene), modes = street, PIPELINES[pipeline]
    plain = track_of(tmp_path, columns, scene, modes)
    for order in permutations(range(1, len(scene.anchors_m))):
        place = np.array([0, *order])
        renumbered = columns | {
            "anchor": 1.0 + np.argsort(place)[columns["anchor"].astype(int) - 1]
        }
        found = track_of(tmp_path, renumbered, with_anchors(scene, scene.anchors_m[place]), modes)
        groups = [*place, len(place)]
        for name in ("nis", "visible", "accepted", "incomplete"):
            found[name] = found[name][:, np.argsort(groups)]
        assert_moved(found, plain)


UNITS = {
    "milliseconds": ("time_s", "time_ms", 1e3),
    "nanoseconds of flight": ("toa_s", "toa_ns", 1e9),
    "meters": ("toa_s", "range_m", 299_792_458.0),
    "degrees of arrival": ("aoa_azimuth_rad", "aoa_azimuth_deg", 180.0 / np.pi),
    "degrees of elevation": ("aoa_elevation_rad", "aoa_elevation_deg", 180.0 / np.pi),
    "degrees of departure": ("aod_azimuth_rad", "aod_azimuth_deg", 180.0 / np.pi),
    "kilohertz": ("doppler_hz", "doppler_khz", 1e-3),
    "meters per second": ("doppler_hz", "doppler_mps", 299_792_458.0 / 28e9),
    "kilohertz of spread": ("doppler_spread_hz", "doppler_spread_khz", 1e-3),
}


@pytest.mark.parametrize("unit", UNITS)
def test_units_are_a_matter_of_column_names(street, tmp_path, unit):
    (columns, scene), modes = street, PIPELINES["ukf"]
    old, new, factor = UNITS[unit]
    scaled = {**columns, new: factor * columns[old]}
    del scaled[old]
    plain = track_of(tmp_path, columns, scene, modes)
    assert_moved(track_of(tmp_path, scaled, scene, modes), plain)


@pytest.mark.parametrize("pipeline", ["ekf", "ukf-robust", "imm"])
@pytest.mark.parametrize("at", [1, 7, 64])
def test_a_log_in_parts_gives_the_track_of_the_whole(street, tmp_path, pipeline, at):
    columns, scene = street
    modes = best_bank("standard") if pipeline == "imm" else PIPELINES[pipeline]
    plain = track_of(tmp_path, columns, scene, modes)
    begins = columns["time_s"] < np.unique(columns["time_s"])[at]
    parts = []
    for name, rows in (("first.csv", begins), ("rest.csv", ~begins)):
        parts.append(tmp_path / name)
        write_columns(parts[-1], {key: values[rows] for key, values in columns.items()})
    blocks = chain.from_iterable(read_log(part, scene, epochs_per_block=50) for part in parts)
    found = joined(localize(blocks, scene, RADIO, modes))
    assert_moved(found, plain)


def test_a_later_clock_and_a_packed_file_change_nothing(street, tmp_path):
    (columns, scene), modes = street, PIPELINES["ukf"]
    plain = track_of(tmp_path, columns, scene, modes)
    later = columns | {"time_s": columns["time_s"] + 1024.0}
    assert_moved(track_of(tmp_path, later, scene, modes), plain)
    packed = tmp_path / "packed.csv.gz"
    write_columns(tmp_path / "log.csv", columns)
    packed.write_bytes(gzip.compress((tmp_path / "log.csv").read_bytes()))
    assert_moved(located(packed, scene, modes), plain)


def test_columns_and_the_rows_of_an_epoch_have_no_order(street, tmp_path):
    (columns, scene), modes = street, [replace(PIPELINES["ekf"][0], spread_gain=0.01)]
    plain = track_of(tmp_path, columns, scene, modes)
    order = np.lexsort((-columns["anchor"], columns["time_s"]))
    shuffled = {name: columns[name][order] for name in reversed(columns)}
    assert_moved(track_of(tmp_path, shuffled, scene, modes), plain)
