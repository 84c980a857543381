"""MATLAB's files of versions 5 to 7: arrays of numbers, and nothing else of what they may hold.

A file is a preamble and elements: kind, length, content. Matrices are elements of elements: flags,
dimensions, name, numbers. scipy reads more of them, but a damaged file can end its process, and it
allocates whatever a length claims.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_BYTES = 2**29  # of what a file holds, without its compression
_PREAMBLE = 128  # bytes; the last two tell the order of bytes in numbers
_ORDER = {b"IM": "<", b"MI": ">"}
_MATRIX, _COMPRESSED = 14, 15  # kinds of elements, beside those of numbers:
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_OTHERS = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse"}  # classes of matrices
_LAST_CLASS, _COMPLEX = 15, 0x800


class MatArray:
    """The array named ``key`` in a MATLAB file, which is read as a whole.

    Args:
        path: of the file.
        key: name of the array.

    Attributes:
        shape, dtype: of the array.

    Raises:
        Exception: of many kinds: not such a file, a damaged one, one of more than MOST_BYTES, no
            such array, or not one of real numbers.
    """

    def __init__(self, path: Path, key: str) -> None:
        content, order = _content(path)
        names = []
        for matrix in _matrices(content, order):
            flags, dims, name, *values = _elements(matrix, order)
            names.append(bytes(name[1]).decode("ascii"))
            if names[-1] == key:
                self.shape = tuple(np.frombuffer(dims[1], f"{order}i4").tolist())
                self._numbers = _numbers(flags, values, order)
                break
        else:
            raise ValueError(f"only {', '.join(names) or 'nothing'}, no array named {key}")
        self.dtype = self._numbers.dtype
        if min(self.shape) < 0 or math.prod(self.shape) != len(self._numbers):
            raise ValueError(f"shape {self.shape} of {len(self._numbers)} numbers")

    def rows(self, wanted: NDArray[np.int_] | None) -> NDArray[Any]:
        """Rows (R, ...) by their numbers (R,), in any order; None for all."""
        array = self._numbers.reshape(self.shape, order="F")
        return array if wanted is None else array[wanted]


def _content(path: Path) -> tuple[memoryview, str]:
    """What follows the preamble, and the order of bytes in numbers."""
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes, more than {MOST_BYTES}: save it as .npy")
    content = path.read_bytes()
    if content.startswith(b"MATLAB 7.3"):
        raise ValueError("HDF5 of MATLAB 7.3: save it with the option -v7")
    mark = content[_PREAMBLE - 2 : _PREAMBLE]
    if mark not in _ORDER:
        raise ValueError("no file of MATLAB 5 to 7")
    return memoryview(content)[_PREAMBLE:], _ORDER[mark]


def _matrices(content: memoryview, order: str) -> Iterator[memoryview]:
    """The matrices of a file, not compressed."""
    for kind, element in _elements(content, order, padded=False):
        if kind == _COMPRESSED:
            ((kind, element),) = _elements(_decompressed(element), order)  # noqa: PLW2901
        if kind == _MATRIX:
            yield element


def _elements(
    content: memoryview, order: str, padded: bool = True
) -> Iterator[tuple[int, memoryview]]:
    """Kinds and contents of the elements that follow each other.

    Those within a matrix begin at multiples of eight bytes; one of up to four bytes may stand
    within its own head.
    """
    at = 0
    while at < len(content):
        kind, length = struct.unpack_from(f"{order}II", content, at)
        begin, end = at + 8, at + 8 + length
        if kind >> 16:
            kind, length = kind & 0xFFFF, kind >> 16
            begin, end = at + 4, at + 4 + length
        if end > len(content):
            raise ValueError(f"an element that ends at {end} of {len(content)} bytes")
        yield kind, content[begin:end]
        at = max(end, at + 8)
        at += -at % 8 if padded else 0


def _decompressed(element: memoryview) -> memoryview:
    inflater = zlib.decompressobj()
    plain = inflater.decompress(element, MOST_BYTES)
    if not inflater.eof:
        raise ValueError(f"an element that is cut off, or of more than {MOST_BYTES} bytes")
    return memoryview(plain)


def _numbers(
    flags: tuple[int, memoryview], values: list[tuple[int, memoryview]], order: str
) -> NDArray[Any]:
    """The numbers of a matrix, one after the other."""
    (word,) = struct.unpack_from(f"{order}I", flags[1])
    if (kind := word & 0xFF) in _OTHERS or kind > _LAST_CLASS or word & _COMPLEX:
        what = "complex numbers" if word & _COMPLEX else _OTHERS.get(kind, f"class {kind}")
        raise ValueError(f"{what}, no array of real numbers")
    ((stored, content),) = values
    if stored not in _NUMBERS:
        raise ValueError(f"numbers of kind {stored}, which there is not")
    return np.frombuffer(content, f"{order}{_NUMBERS[stored]}")
