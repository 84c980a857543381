"""Tests of reading arrays from files: chosen rows, and damaged or forged files."""

import io
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as stn
from numpy.testing import assert_array_equal

from mmwave_env.datasets.deepmimo.v4 import read_array
from tests.refusals import refuses


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
    order=st.sampled_from("CF"),
    data=st.data(),
)
def test_chosen_rows_equal_the_same_rows_in_numpy(folder, array, order, data):
    file = folder / "delay.npz"
    np.savez_compressed(file, delay=np.asarray(array, order=order))
    rows = data.draw(st.lists(st.integers(0, len(array) - 1), max_size=12))
    shape = tuple("NPIX"[: array.ndim])
    chosen = read_array(file, "delay", shape, np.array(rows, int))
    assert chosen.dtype == float
    assert_array_equal(chosen, array[rows])
    assert_array_equal(read_array(file, "delay", shape), array)


def test_a_missing_file_is_named(tmp_path):
    with refuses("power.npz", error=FileNotFoundError):
        read_array(tmp_path / "power.npz", "power", (1,))


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


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("the pickle was executed",)


def pickled():
    """Return the bytes of an array of objects."""
    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb()], object))
    return buffer.getvalue()


BODY = bytes(4 * 12)
FORGED = {
    "1e12 rows": in_archive(npy_header((10**12, 3)) + BODY),
    "one byte too few": in_archive(npy_header((4, 3)) + BODY[1:]),
    "code": in_archive(npy_header((4, 3), "__import__('os')") + BODY),
    "pickles": in_archive(pickled()),
    "4 GB claimed": forged_size(npy_header((10**9 // 3, 3)) + BODY, 2**32 - 2),
    "another name": in_archive(b"", "../delay.npy"),
    "an array alone": npy_header((4, 3)) + BODY,
    "not an archive": b"PK\x03\x04",
}


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_file_is_refused(tmp_path, name):
    file = tmp_path / "delay.npz"
    file.write_bytes(FORGED[name])
    with refuses(file, "delay"):
        read_array(file, "delay", (4, "P"))
