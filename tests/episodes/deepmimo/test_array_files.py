"""Chosen rows of arrays in files, and headers that claim what is not there."""

import io
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as stn
from scipy.io import savemat

from mmwave_env.episodes.deepmimo import array_files, mat_files
from mmwave_env.episodes.deepmimo.array_files import array_shape, find_array, read_array
from tests.episodes.deepmimo.scenarios import SAVE

ANY = ("N", "P")
SMALL = 2**22  # bytes: what reading a small file may take


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return tmp_path_factory.mktemp("arrays")


@settings(max_examples=80, deadline=None)
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
def test_chosen_rows_are_numpys(room, array, suffix, order, data):
    file = room / f"delay{suffix}"
    native = array.astype(array.dtype.newbyteorder("=")) if suffix == ".mat" else array
    native = native.astype(np.float32) if native.dtype == np.float16 else native
    while native.ndim > 2 and native.shape[-1] == 1:  # MATLAB drops these
        native = native[..., 0]
    SAVE[suffix](file, "delay", np.asarray(native, order=order))
    rows = data.draw(st.lists(st.integers(0, len(native) - 1), max_size=12))
    shape = tuple("NPIX"[: native.ndim])
    assert array_shape(file, "delay", shape) == native.shape
    found = read_array(file, "delay", shape, np.array(rows, int))
    assert found.dtype == float
    np.testing.assert_array_equal(found, native[rows])
    np.testing.assert_array_equal(read_array(file, "delay", shape), native)


def test_the_first_format_there_is_counts(tmp_path):
    for suffix in (".mat", ".npy", ".npz"):
        SAVE[suffix](tmp_path / f"delay{suffix}", "delay", np.zeros((2, 2)))
        assert find_array(tmp_path, "delay").suffix == suffix
    with pytest.raises(FileNotFoundError, match="power.npz: found no such file"):
        find_array(tmp_path, "power")


def npy_header(shape, descr="<f4", claimed=None):
    """The beginning of an .npy file, of any shape; ``claimed`` is the length it says it has."""
    text = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", claimed or len(text)) + text


def in_archive(content, name="delay.npy", kind=zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        archive.writestr(name, content)
    return buffer.getvalue()


def forged_size(content, size):
    """An archive of one member that claims another size, both where it begins and in the list."""
    archive = bytearray(in_archive(content))
    listed = archive.rindex(b"PK\x01\x02")
    struct.pack_into("<I", archive, listed + 24, size)
    struct.pack_into("<I", archive, 22, size)
    return bytes(archive)


def mat(array, dims=None, kind=None):
    """A MATLAB file, not compressed, whose header is forged."""
    buffer = io.BytesIO()
    savemat(buffer, {"delay": array})
    content = bytearray(buffer.getvalue())
    if dims:
        struct.pack_into("<ii", content, content.index(struct.pack("<ii", *array.shape)), *dims)
    if kind:
        content[144] = kind
    return bytes(content)


BODY = bytes(4 * 12)
FORGED = {
    "1e12 rows": (".npy", npy_header((10**12, 3)) + BODY, "shape (1000000000000, 3)"),
    "1e300 rows": (".npy", npy_header((10**300, 3)) + BODY, "shape (1000"),
    "fewer than no rows": (".npy", npy_header((-4, -3)) + BODY, "shape (-4, -3)"),
    "a row short": (".npy", npy_header((4, 3)) + BODY[1:], "no more than"),
    "rows of nothing": (".npy", npy_header((10**12, 0)) + BODY, "(1000000000000, 0)"),
    "a long header": (".npy", npy_header((4, 3), claimed=65535) + BODY, "no readable array"),
    "a header of 4 GB": (".npy", b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + BODY, "no readable array"),
    "another version": (".npy", b"\x93NUMPY\x07\x00\x76\x00" + BODY, "version (7, 0)"),
    "code": (".npy", npy_header((4, 3), "__import__('os')") + BODY, "no readable array"),
    "pickles": (".npy", npy_header((4, 3), "|O") + BODY * 2, "type object"),
    "words": (".npy", npy_header((4, 3), "<U1") + BODY, "type <U1"),
    "truths": (".npy", npy_header((4, 3), "|b1") + BODY, "type bool"),
    "records": (".npy", npy_header((4, 3), [("a", "<f4")]) + BODY, "real numbers"),
    "1e12 rows, packed": (".npz", in_archive(npy_header((10**12, 3)) + BODY), "no more than"),
    "4 GB claimed": (
        ".npz",
        forged_size(npy_header((10**9 // 3, 3)) + BODY, 2**32 - 2),
        "no more than",
    ),
    "another name": (".npz", in_archive(b"", "../delay.npy"), "only ../delay, no array named"),
    "another compression": (
        ".npz",
        in_archive(npy_header((4, 3)) + BODY, kind=zipfile.ZIP_LZMA),
        "compression 14",
    ),
    "no archive": (".npz", b"PK\x03\x04", "no readable array"),
    "too many MATLAB rows": (".mat", mat(np.zeros((4, 3)), (2**30, 3)), "shape (1073741824, 3)"),
    "more MATLAB columns": (".mat", mat(np.zeros((4, 3)), (4, 4)), "no readable array"),
    "MATLAB words": (".mat", mat(np.array(["abc"])), "char, no array of real numbers"),
    "MATLAB complex": (".mat", mat(np.ones((4, 3)) * 1j), "complex numbers"),
    "MATLAB cell": (".mat", mat(np.array([[1, "a"]], object)), "cell, no array of real numbers"),
    "MATLAB 7.3": (".mat", b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(600), "-v7"),
    "no MATLAB": (".mat", bytes(1000), "no file of MATLAB 5 to 7"),
    "MATLAB cut off": (".mat", mat(np.zeros((4, 3)))[:-8], "an element that ends at"),
}


@pytest.mark.parametrize("what", FORGED)
def test_what_a_header_claims_is_refused_before_anything_is_allocated(tmp_path, what):
    suffix, content, expected = FORGED[what]
    file = tmp_path / f"delay{suffix}"
    file.write_bytes(content)
    np.load(io.BytesIO(npy_header((1, 1)) + BODY))  # imports
    tracemalloc.start()
    with pytest.raises(ValueError, match="delay") as error:
        read_array(file, "delay", (4, "P"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert str(file) in str(error.value) and expected in str(error.value), error.value
    assert peak < SMALL


def test_a_bomb_is_refused_by_what_it_would_take(tmp_path, monkeypatch):
    most = 2**20
    monkeypatch.setattr(array_files, "MOST_BYTES", most)
    monkeypatch.setattr(mat_files, "MOST_BYTES", most)
    zeros = np.zeros((most // 8 + 1, 1), np.float32)
    for suffix, words in ((".npz", "choose users"), (".mat", "more than 1048576 bytes")):
        file = tmp_path / f"delay{suffix}"
        wide = zeros if suffix == ".npz" else zeros.astype(float)
        SAVE[suffix](file, "delay", wide)
        assert file.stat().st_size < 2**13
        with pytest.raises(ValueError, match=words):
            read_array(file, "delay", ANY)
    chosen = read_array(tmp_path / "delay.npz", "delay", ANY, np.array([most // 8, 0]))
    np.testing.assert_array_equal(chosen, [[0.0], [0.0]])


def test_a_damaged_archive_is_found_wherever_it_is_damaged(tmp_path):
    file = tmp_path / "delay.npz"
    np.savez(file, delay=np.ones((500, 9)))
    content = bytearray(file.read_bytes())
    content[-500] ^= 1  # within the last rows
    file.write_bytes(content)
    with pytest.raises(ValueError, match="Bad CRC-32"):
        read_array(file, "delay", ANY, np.array([0]))


def test_damaged_compression_of_matlab_is_found(tmp_path):
    file = tmp_path / "delay.mat"
    SAVE[".mat"](file, "delay", np.arange(500.0).reshape(100, 5))
    content = bytearray(file.read_bytes())
    content[-2] ^= 1  # its checksum
    file.write_bytes(content)
    with pytest.raises(ValueError, match="no readable array") as error:
        read_array(file, "delay", ANY)
    assert isinstance(error.value.__cause__, zlib.error)


@settings(max_examples=150, deadline=None)
@given(
    suffix=st.sampled_from(sorted(SAVE)),
    packed=st.booleans(),
    cut=st.none() | st.floats(0.0, 1.0),
    flips=st.lists(st.tuples(st.floats(0.0, 0.999), st.integers(1, 255)), max_size=4),
)
@pytest.mark.filterwarnings("ignore")
def test_random_damage_is_refused_or_harmless(room, suffix, packed, cut, flips):
    file = room / f"power{suffix}"
    array = np.arange(60, dtype=np.float32).reshape(20, 3)
    if suffix == ".mat" and not packed:
        savemat(file, {"power": array})
    elif suffix == ".npz" and not packed:
        np.savez(file, power=array)
    else:
        SAVE[suffix](file, "power", array)
    content = bytearray(file.read_bytes())
    for where, mask in flips:
        content[int(where * len(content))] ^= mask
    file.write_bytes(content[: len(content) if cut is None else int(cut * len(content))])
    try:
        found = read_array(file, "power", ("N", 3), np.array([0, 7]))
    except ValueError as error:
        assert str(file) in str(error)  # noqa: PT017  not every damage is an error
    else:
        assert found.shape == (2, 3) and found.dtype == float
