"""Tests of reading arrays from files: chosen rows, and damaged or forged files."""

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as stn
from numpy.testing import assert_array_equal

from mmwave_env.datasets.deepmimo import v4
from mmwave_env.datasets.deepmimo.v4 import find_array, read_array
from tests.datasets.deepmimo.scenarios import SAVE
from tests.refusals import refuses

ANY = ("N", "P")  # shape of an array with two axes of any length
SMALL = 2**22  # bytes of memory that reading a small file may need


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("arrays")


@settings(max_examples=80)
@given(
    array=stn.arrays(
        st.sampled_from([">f4", "<f4", "f8", "f2", "i4", ">u2", "u1"]),
        stn.array_shapes(min_dims=2, max_dims=4, max_side=9),
        elements={"min_value": 0, "max_value": 200},
    ),
    suffix=st.sampled_from(sorted(SAVE)),
    order=st.sampled_from("CF"),
    data=st.data(),
)
def test_chosen_rows_equal_the_same_rows_in_numpy(folder, array, suffix, order, data):
    file = folder / f"delay{suffix}"
    SAVE[suffix](file, "delay", np.asarray(array, order=order))
    rows = data.draw(st.lists(st.integers(0, len(array) - 1), max_size=12))
    shape = tuple("NPIX"[: array.ndim])
    chosen = read_array(file, "delay", shape, np.array(rows, int))
    assert chosen.dtype == float
    assert_array_equal(chosen, array[rows])
    assert_array_equal(read_array(file, "delay", shape), array)


def test_an_npz_file_is_preferred_to_an_npy_file(tmp_path):
    for suffix in (".npy", ".npz"):
        SAVE[suffix](tmp_path / f"delay{suffix}", "delay", np.zeros((2, 2)))
        assert find_array(tmp_path, "delay").suffix == suffix
    with refuses("power.npz", error=FileNotFoundError):
        find_array(tmp_path, "power")


def npy_header(shape, descr="<f4"):
    """Return the header of an .npy file."""
    text = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def in_archive(content, name="delay.npy"):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return buffer.getvalue()


def forged_size(content, size):
    """Return an archive whose member has a false size, in its own header and in the directory."""
    archive = bytearray(in_archive(content))
    listed = archive.rindex(b"PK\x01\x02")
    struct.pack_into("<I", archive, listed + 24, size)
    struct.pack_into("<I", archive, 22, size)
    return bytes(archive)


BODY = bytes(4 * 12)
FORGED = {
    "1e12 rows": (".npy", npy_header((10**12, 3)) + BODY),
    "one byte too few": (".npy", npy_header((4, 3)) + BODY[1:]),
    "code": (".npy", npy_header((4, 3), "__import__('os')") + BODY),
    "pickles": (".npy", npy_header((4, 3), "|O") + BODY * 2),
    "1e12 rows, packed": (".npz", in_archive(npy_header((10**12, 3)) + BODY)),
    "4 GB claimed": (".npz", forged_size(npy_header((10**9 // 3, 3)) + BODY, 2**32 - 2)),
    "another name": (".npz", in_archive(b"", "../delay.npy")),
    "not an archive": (".npz", b"PK\x03\x04"),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_header_is_refused_without_allocating_memory(tmp_path, name):
    suffix, content = FORGED[name]
    file = tmp_path / f"delay{suffix}"
    SAVE[suffix](file, "delay", np.zeros((4, 3)))
    read_array(file, "delay", (4, "P"))  # so that imports do not count as memory
    file.write_bytes(content)
    tracemalloc.start()
    with refuses(file, "delay"):
        read_array(file, "delay", (4, "P"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # For the packed file, numpy reserves all memory that the header claims, but does not use it.
    assert peak < SMALL or name == "1e12 rows, packed"


def test_a_small_archive_with_a_large_array_is_refused(tmp_path, monkeypatch):
    most = 2**20
    monkeypatch.setattr(v4, "MOST_BYTES", most)
    zeros = np.zeros((most // 8 + 1, 1))
    file = tmp_path / "delay.npz"
    SAVE[".npz"](file, "delay", zeros)
    assert file.stat().st_size < 2**13
    with refuses(file, "delay"):
        read_array(file, "delay", ANY)


def test_only_the_chosen_rows_of_an_npy_file_are_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(v4, "MOST_BYTES", 2**10)
    file = tmp_path / "delay.npy"
    rows = np.lib.format.open_memmap(file, "w+", np.float32, (2**22, 25))  # 400 MB, sparse
    rows[[7, 2**22 - 1]] = 3.0
    del rows
    tracemalloc.start()
    chosen = read_array(file, "delay", ANY, np.array([2**22 - 1, 6, 7]))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert_array_equal(chosen[:, 0], [3.0, 0.0, 3.0])
    assert peak < SMALL
    with refuses(file, "delay"):
        read_array(file, "delay", ANY)
