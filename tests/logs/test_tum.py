"""Tests of TUM files: read back as written, read by evo, refused if damaged, and interpolated."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal
from scipy.interpolate import CubicHermiteSpline

from mmwave_env.logs.truth import BRIDGED_S, TOLERANCE_S, Truth
from mmwave_env.logs.tum import read_tum, tum_lines
from tests.logs import by_hand
from tests.refusals import refuses

POSES = "0.0 1 2 3 0 0 0 1\n0.1 1.5 2 3 0 0 0 1\n0.2 2 2 3 0 0 0 1\n"
coordinates = st.floats(-1e6, 1e6)


store = partial(by_hand.store, name="truth.tum")


@settings(max_examples=30)
@given(
    track=arrays(float, st.tuples(st.integers(1, 20), st.just(3)), elements=coordinates),
    start=coordinates,
    step=st.floats(1e-3, 1e3),
)
def test_a_written_track_is_read_back_exactly(tmp_path_factory, track, start, step):
    time = start + step * np.arange(len(track))
    path = store(tmp_path_factory.mktemp("tum"), tum_lines(time, track))
    poses = read_tum(path)
    assert_array_equal(poses.time_s, time)
    assert_array_equal(poses.position_m, track)


def test_evo_reads_our_files(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    time = 1.7e9 + 0.1 * np.arange(300)
    track = np.cumsum(np.random.default_rng(1).standard_normal((300, 3)), axis=0)
    path = store(tmp_path, "# t x y z qx qy qz qw\n" + tum_lines(time, track))
    read = file_interface.read_tum_trajectory_file(str(path))
    assert_array_equal(read.timestamps, time)
    assert_array_equal(read.positions_xyz, track)


SPELLINGS = {
    "comment": lambda s: "# a comment\n\n" + s,
    "comments between": lambda s: s.replace("\n", "\n  # between\n"),
    "comments behind": lambda s: s.replace("\n", " # behind\n"),
    "CRLF": lambda s: s.replace("\n", "\r\n"),
    "tabs": lambda s: s.replace(" ", "\t\t "),
    "no end": lambda s: s.rstrip("\n"),
    "BOM": lambda s: "\ufeff" + s + "\n \n",
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_comments_spaces_line_ends_and_a_byte_order_mark_do_not_change_what_is_read(tmp_path, name):
    poses = read_tum(store(tmp_path, SPELLINGS[name](POSES)))
    assert poses.time_s.tolist() == [0.0, 0.1, 0.2]
    assert poses.position_m.tolist() == [[1.0, 2.0, 3.0], [1.5, 2.0, 3.0], [2.0, 2.0, 3.0]]


DAMAGE = {  # damaged line -> comma and name of the damaged column, if the message names a column
    "0.15 1 2 3 0 0 1": "",
    "0.15,1,2,3,0,0,0,1": "",
    "0.15 1 two 3 0 0 0 1": ", y",
    "0.15 1 2_0 3 0 0 0 1": ", y",
    "0.15 1 2 nan 0 0 0 1": ", z",
    "0.05 1 2 3 0 0 0 1": ", t",
    "0.15 1 2 3\udcff 0 0 0 1": ", z",  # not UTF-8
}


@pytest.mark.parametrize("line", DAMAGE, ids=ascii)
def test_the_error_names_a_damaged_line(tmp_path, line):
    first, second, third, _ = POSES.split("\n")
    content = "\n".join([f"# {first}", first, "", second, line, third]) + "\n"
    path = store(tmp_path, content.encode("utf-8", "surrogateescape"))
    with refuses(f"{path}, line 5{DAMAGE[line]}"):
        read_tum(path)


def test_of_poses_at_one_time_the_first_is_read_and_the_others_are_counted(tmp_path):
    lines = POSES.splitlines()
    path = store(tmp_path, "\n".join([lines[0], lines[0], lines[1], "0.1 9 9 9 0 0 0 1", lines[2]]))
    with pytest.warns(UserWarning, match="line 2: .*; such poses, left out: 2"):
        poses = read_tum(path)
    assert poses.time_s.tolist() == [0.0, 0.1, 0.2]
    assert poses.position_m[:, 0].tolist() == [1.0, 1.5, 2.0]


@pytest.mark.parametrize("content", ["", "\n\n", "# t x y z qx qy qz qw\n"])
def test_a_file_without_poses_is_refused(tmp_path, content):
    path = store(tmp_path, content)
    with refuses(path):
        read_tum(path)


@pytest.mark.parametrize("line", ["0 1 2 3 0 0\r0 1", "0 1 2 3 0 0 0 1\r1 1 2 3 0 0 0 1"])
def test_a_carriage_return_inside_a_line_is_refused(tmp_path, line):
    path = store(tmp_path, f"# t x y z\r\n{line}\n")
    with refuses(f"{path}, line"):
        read_tum(path)


def truth_of(folder, time_s, position_m):
    return Truth(store(folder, tum_lines(time_s, position_m)))


def expected(pose_s, position, time_s):
    """Return positions from SciPy's cubic splines; NaN in gaps."""
    p = np.full((len(time_s), 3), np.nan)
    runs = np.split(np.arange(len(pose_s)), np.flatnonzero(np.diff(pose_s) > BRIDGED_S) + 1)
    for run in runs:
        t = pose_s[run]
        x = position[run]
        away = np.abs(time_s[:, None] - t)
        near = away.min(axis=1) <= TOLERANCE_S
        p[near] = x[away[near].argmin(axis=1)]
        if len(run) > 1:
            curve = CubicHermiteSpline(t, x, np.gradient(x, t, axis=0))
            inside = (time_s >= t[0]) & (time_s <= t[-1])
            p[inside] = curve(time_s[inside])
    return p


times = st.lists(st.integers(0, 4000), min_size=1, max_size=60, unique=True)


@settings(max_examples=80)
@given(poses=times, epochs=times, late=st.sampled_from([0.0, 1e-3]))
def test_poses_are_interpolated_but_not_across_gaps(tmp_path_factory, poses, epochs, late):
    pose_s = np.sort(poses) * 1e-2
    time_s = np.sort(epochs) * 1e-2 + late
    position = np.random.default_rng(0).standard_normal((len(pose_s), 3))
    truth = truth_of(tmp_path_factory.mktemp("truth"), pose_s, position)
    assert_allclose(truth.at(time_s), expected(pose_s, position, time_s), atol=1e-9)
