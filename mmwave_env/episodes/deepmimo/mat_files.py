"""MATLAB's files of versions 5 to 7: arrays of numbers, and cells and structs of such arrays.

A file is a preamble and elements: kind, length, content. Matrices are elements of elements: flags,
dimensions, name, and numbers, or matrices again. What is not asked for is skipped. scipy reads more
of them, but a damaged file can end its process, and it allocates whatever a length claims.

Source: MathWorks, MAT-File Format, Level 5.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
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
_CELL, _STRUCT = "cell", "struct"
_OTHERS = {1: _CELL, 2: _STRUCT, 3: "object", 4: "char", 5: "sparse"}  # classes of matrices
_LAST_CLASS, _COMPLEX = 15, 0x800


@dataclass(frozen=True, eq=False)
class Matrix:
    """A matrix of a file.

    Attributes:
        name: of a variable; empty inside of cells and structs.
        shape: of it.
        kind: "numbers", or what else it holds, such as "cell".
        parts: what follows its name, kinds and contents.
        order: of bytes in numbers, as of numpy.
    """

    name: str
    shape: tuple[int, ...]
    kind: str
    parts: list[tuple[int, memoryview]]
    order: str

    def numbers(self) -> NDArray[Any]:
        """The array itself.

        Raises:
            ValueError: it does not hold real numbers, or not as many as its shape says.
        """
        if self.kind != "numbers":
            raise ValueError(f"{self.kind}, no array of real numbers")
        ((stored, content),) = self.parts or [(9, memoryview(b""))]
        if stored not in _NUMBERS:
            raise ValueError(f"numbers of kind {stored}, which there is not")
        numbers = np.frombuffer(content, f"{self.order}{_NUMBERS[stored]}")
        if math.prod(self.shape) != len(numbers):
            raise ValueError(f"shape {self.shape} of {len(numbers)} numbers")
        return numbers.reshape(self.shape, order="F")

    def cell(self, index: int) -> "Matrix":
        """An entry of a cell array, counted from 0, column by column.

        Raises:
            Exception: of many kinds: it is none, has fewer entries, or a damaged one.
        """
        if self.kind != _CELL or index >= len(self.parts):
            raise ValueError(f"{len(self.parts)} entries of {self.kind}, no cell {index + 1}")
        return _matrix(self.parts[index][1], self.order)

    def field(self, name: str) -> "Matrix":
        """A field of a struct.

        Raises:
            Exception: of many kinds: it is no single struct, has no such field, or a damaged one.
        """
        if self.kind != _STRUCT or math.prod(self.shape) != 1:
            raise ValueError(f"{self.kind} of shape {self.shape}, no struct")
        (_, width), (_, letters), *values = self.parts
        (length,) = struct.unpack(f"{self.order}i", width)
        names = [
            bytes(letters[at : at + length]).partition(b"\0")[0].decode("ascii")
            for at in range(0, len(letters), max(length, 1))
        ]
        if name not in names:
            raise ValueError(f"only {', '.join(names) or 'nothing'}, no field {name}")
        return _matrix(values[names.index(name)][1], self.order)


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
        names = []
        for variable in variables(path):
            names.append(variable.name)
            if names[-1] == key:
                self._array = variable.numbers()
                break
        else:
            raise ValueError(f"only {', '.join(names) or 'nothing'}, no array named {key}")
        self.shape, self.dtype = self._array.shape, self._array.dtype

    def rows(self, wanted: NDArray[np.int_] | None) -> NDArray[Any]:
        """Rows (R, ...) by their numbers (R,), in any order; None for all."""
        return self._array if wanted is None else self._array[wanted]


def variables(path: Path) -> Iterator[Matrix]:
    """The variables of a file, one in memory at a time.

    Raises:
        Exception: of many kinds: not such a file, a damaged one, or one of more than MOST_BYTES.
    """
    content, order = _content(path)
    for element in _matrices(content, order):
        yield _matrix(element, order)


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


def _matrix(element: memoryview, order: str) -> Matrix:
    """What a matrix is; one without a byte is empty."""
    if not element:
        return Matrix("", (0, 0), "numbers", [], order)
    (_, flags), (_, dims), (_, name), *parts = _elements(element, order)
    (word,) = struct.unpack_from(f"{order}I", flags)
    shape = tuple(np.frombuffer(dims, f"{order}i4").tolist())
    if min(shape, default=-1) < 0:
        raise ValueError(f"shape {shape}")
    return Matrix(bytes(name).decode("ascii"), shape, _kind(word), parts, order)


def _kind(flags: int) -> str:
    number = flags & 0xFF
    if number in _OTHERS or number > _LAST_CLASS:
        return _OTHERS.get(number, f"class {number}")
    return "complex numbers" if flags & _COMPLEX else "numbers"


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
