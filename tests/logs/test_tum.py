"""TUM trajectories: there and back, as evo reads them, and what is refused where."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mmwave_env.logs.tum import read_tum, tum_blocks, tum_lines

POSES = "0.0 1 2 3 0 0 0 1\n0.1 1.5 2 3 0 0 0 1\n0.2 2 2 3 0 0 0 1\n"
coordinates = st.floats(-1e6, 1e6)


def store(folder, content):
    path = folder / "truth.tum"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@settings(max_examples=30, deadline=None)
@given(track=arrays(float, st.tuples(st.integers(1, 20), st.just(3)), elements=coordinates),
       start=coordinates, step=st.floats(1e-3, 1e3))  # fmt: skip
def test_a_track_survives_a_file(tmp_path_factory, track, start, step):
    time = start + step * np.arange(len(track))
    path = store(tmp_path_factory.mktemp("tum"), tum_lines(time, track))
    found = read_tum(path)
    np.testing.assert_array_equal(found.time_s, time)
    np.testing.assert_array_equal(found.position_m, track)


def test_a_file_is_read_block_by_block(tmp_path, monkeypatch):
    track = np.random.default_rng(0).standard_normal((200, 3))
    path = store(tmp_path, "# by hand\n" * 50 + tum_lines(np.arange(200.0), track))
    monkeypatch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", 300)
    blocks = list(tum_blocks(path))
    assert len(blocks) > 20 and all(len(block.time_s) for block in blocks)
    np.testing.assert_array_equal(np.concatenate([b.time_s for b in blocks]), np.arange(200.0))
    np.testing.assert_array_equal(np.concatenate([b.position_m for b in blocks]), track)


def test_evo_reads_our_files(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    time = 1.7e9 + 0.1 * np.arange(300)
    track = np.cumsum(np.random.default_rng(1).standard_normal((300, 3)), axis=0)
    path = store(tmp_path, "# t x y z qx qy qz qw\n" + tum_lines(time, track))
    read = file_interface.read_tum_trajectory_file(str(path))
    np.testing.assert_array_equal(read.timestamps, time)
    np.testing.assert_array_equal(read.positions_xyz, track)


@pytest.mark.parametrize(
    "change",
    [
        lambda s: "# a comment\n\n" + s,
        lambda s: s.replace("\n", "\n  # between\n"),
        lambda s: s.replace("\n", " # behind\n"),
        lambda s: s.replace("\n", "\r\n"),
        lambda s: s.replace(" ", "\t\t "),
        lambda s: s.rstrip("\n"),
        lambda s: "\ufeff" + s + "\n \n",
    ],
    ids=["comment", "comments between", "comments behind", "CRLF", "tabs", "no end", "BOM"],
)
def test_spellings(tmp_path, change):
    found = read_tum(store(tmp_path, change(POSES)))
    assert found.time_s.tolist() == [0.0, 0.1, 0.2]
    assert found.position_m.tolist() == [[1.0, 2.0, 3.0], [1.5, 2.0, 3.0], [2.0, 2.0, 3.0]]


DAMAGE = {
    "7 numbers": ("0.15 1 2 3 0 0 1", "line 5: found 7 numbers, expected 8: t x y z qx qy qz qw"),
    "commas": ("0.15,1,2,3,0,0,0,1", "line 5: found 1 numbers, expected 8"),
    "word": ("0.15 1 two 3 0 0 0 1", "line 5, y: found 'two', expected a finite number"),
    "underscore": ("0.15 1 2_0 3 0 0 0 1", "line 5, y: found '2_0', expected a finite number"),
    "NaN": ("0.15 1 2 nan 0 0 0 1", "line 5, z: found 'nan', expected a finite number"),
    "time back": ("0.05 1 2 3 0 0 0 1", "line 5, t: found 0.05, expected more than 0.1"),
    "not UTF-8": ("0.15 1 2 3\udcff 0 0 0 1", r"line 5, z: found '3\\\\xff', expected a finite"),
}


@pytest.mark.parametrize("block_bytes", [40, 50, 1 << 20])
@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_line_is_named(tmp_path, monkeypatch, name, block_bytes):
    line, message = DAMAGE[name]
    first, second, third, _ = POSES.split("\n")
    content = "\n".join([f"# {first}", first, "", second, line, third]) + "\n"
    path = store(tmp_path, content.encode("utf-8", "surrogateescape"))
    monkeypatch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", block_bytes)
    with pytest.raises(ValueError, match=message) as error:
        read_tum(path)
    assert str(error.value).startswith(f"{path}, line 5")


@pytest.mark.parametrize("content", ["", "\n\n", "# t x y z qx qy qz qw\n"])
def test_a_file_without_poses(tmp_path, content):
    path = store(tmp_path, content)
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}: found no line with a pose"):
        read_tum(path)


@pytest.mark.parametrize("line", ["0 1 2 3 0 0\r0 1", "0 1 2 3 0 0 0 1\r1 1 2 3 0 0 0 1"])
def test_a_line_end_inside_a_line_is_refused(tmp_path, line):
    path = tmp_path / "t.tum"
    path.write_bytes(f"# t x y z\r\n{line}\n".encode())
    with pytest.raises(ValueError, match=r"t.tum, lines? \d"):
        read_tum(path)
