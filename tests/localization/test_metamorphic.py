"""Tests that an equivalent description of a log and its scene gives an equivalent track.

The correct track of a log is unknown. But we know how the track must change with the description.
If the scene is moved, turned or mirrored, so are the track and its covariances. If anchors are
renumbered, the track stays the same. NIS and gate decisions never change.
"""

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mmwave_env.filters.bank import named_modes
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import read_scene
from tests.filters.tracks import assert_same_beliefs, packed, unpacked
from tests.localization.mistakes import AZIMUTHS, FOLDERS, read_columns, write_columns

pytestmark = pytest.mark.slow  # all tests together take half a minute

RADIO = RADIOS["standard"]
PIPELINES = {name: [mode] for name, mode in named_modes("standard").items()}
# Sigma points of all other modes lie along the map's axes: turning the map changes their tracks.
ROTATABLE = ["ekf", "ekf-robust"]
ROUNDING = 1e-6  # largest difference between two tracks, in standard deviations
UNTURNED = np.eye(3)


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda folder: folder.name)
def street(request):
    """Return the columns of a log's first 15 s, and its scene."""
    columns = read_columns(request.param / "log.csv")
    first = columns["time_s"] < 15.0
    scene = read_scene(request.param / "scene.json")
    return {name: values[first] for name, values in columns.items()}, scene


def track(folder, columns, scene, modes):
    """Write a log and localize it; return every array of the track by name."""
    write_columns(folder / "log.csv", columns)
    log = read_log(folder / "log.csv", scene).whole()
    return localize(log, scene, RADIO, Switching(modes)).arrays()


def assert_moved(moved, plain, turn=UNTURNED, shift_m=(0.0, 0.0, 0.0)):
    """Assert that ``moved`` equals the track ``plain``, turned by a matrix (3, 3) and shifted."""
    whole = np.eye(7)
    whole[:3, :3] = whole[3:6, 3:6] = turn
    for x, P in (("x", "P"), ("smooth_x", "smooth_P")):
        expected = plain[x] @ whole.T + [*shift_m, 0.0, 0.0, 0.0, 0.0]
        covariance = whole @ unpacked(plain[P]) @ whole.T
        ours = {"x": moved[x], "P": moved[P]}
        theirs = {"x": expected, "P": packed(covariance)}
        assert_same_beliefs(ours, theirs, rtol=ROUNDING)
    np.testing.assert_allclose(moved["nis"], plain["nis"], rtol=1e-6, atol=1e-6)
    for name in ("visible", "accepted", "incomplete", "mode"):
        np.testing.assert_array_equal(moved[name], plain[name], err_msg=name)


def turned(angle):
    turn = Rotation.from_euler("z", angle).as_matrix()
    return ROTATABLE, turn, (0.0, 0.0, 0.0), lambda azimuth: azimuth + angle


def mirrored(signs, offset):
    return PIPELINES, np.diag(signs), (0.0, 0.0, 0.0), lambda azimuth: offset - azimuth


MOVES = {  # name -> pipelines, turn (3, 3), shift in m, function that converts azimuths
    "elsewhere": (PIPELINES, UNTURNED, (812.5, -4_096.25, 37.0), lambda azimuth: azimuth),
    "to UTM": (PIPELINES, UNTURNED, (691e3, 5_334e3, 520.0), lambda azimuth: azimuth),
    **{f"turned by {angle:.1f}": turned(angle) for angle in (0.5 * np.pi, np.pi, -2.0, 0.3)},
    "mirrored in x": mirrored([-1.0, 1.0, 1.0], np.pi),
    "mirrored in y": mirrored([1.0, -1.0, 1.0], 0.0),
}


@pytest.mark.parametrize(
    ("move", "pipeline"), [(move, pipeline) for move in MOVES for pipeline in MOVES[move][0]]
)
def test_a_moved_scene_gives_the_moved_track(street, tmp_path, move, pipeline):
    (columns, scene) = street
    modes = PIPELINES[pipeline]
    _, turn, shift_m, azimuths = MOVES[move]
    moved_columns = columns | {name: azimuths(columns[name]) for name in AZIMUTHS}
    place = scene.with_anchors(scene.anchors_m @ turn.T + shift_m)
    plain = track(tmp_path, columns, scene, modes)
    assert_moved(track(tmp_path, moved_columns, place, modes), plain, turn, shift_m)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_the_order_of_virtual_anchors_does_not_matter(street, tmp_path, pipeline):
    (columns, scene) = street
    modes = PIPELINES[pipeline]
    plain = track(tmp_path, columns, scene, modes)
    for order in permutations(range(1, len(scene.anchors_m))):
        numbers = np.array([0, *order])
        anchor = 1.0 + np.argsort(numbers)[columns["anchor"].astype(int) - 1]
        other = scene.with_anchors(scene.anchors_m[numbers])
        renamed = track(tmp_path, columns | {"anchor": anchor}, other, modes)
        groups = [*numbers, len(numbers)]
        for name in ("nis", "visible", "accepted", "incomplete"):
            renamed[name] = renamed[name][:, np.argsort(groups)]
        assert_moved(renamed, plain)


def test_a_later_clock_in_milliseconds_and_rows_in_another_order_do_not_matter(street, tmp_path):
    (columns, scene) = street
    modes = PIPELINES["ukf"]
    plain = track(tmp_path, columns, scene, modes)
    order = np.lexsort((-columns["anchor"], columns["time_s"]))
    written = {name: values[order] for name, values in reversed(columns.items())}
    written["time_ms"] = 1e3 * (written.pop("time_s") + 1024.0)
    assert_moved(track(tmp_path, written, scene, modes), plain)
