"""Arrays of numbers in MATLAB files of versions 5 to 7.

``scipy.io.loadmat`` ends the process on some damaged files (an unknown kind of numbers indexes past
its table), so the few parts of the format that a matrix of real numbers has are read here.

Source: MathWorks, MAT-File Format, Level 5.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PREAMBLE = 128  # bytes; the last two tell the order of bytes in numbers
_ORDER = {b"IM": "<", b"MI": ">"}
_COMPRESSED = 15  # a kind of elements, beside those of numbers:
_TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8"]
_NUMBERS = dict(zip((*range(1, 8), 9, 12, 13), _TYPES, strict=True))
_CLASSES, _COMPLEX = range(6, 16), 0x800  # classes of matrices of numbers; a flag


def read_matlab(file: Path, key: str, most_bytes: int) -> NDArray[Any]:
    """The matrix of real numbers named ``key``.

    Args:
        file: MATLAB file.
        key: name of a variable.
        most_bytes: of the file, and of a variable without its compression.

    Raises:
        Exception: of many kinds: no such file, no such matrix, or too long a one.
    """
    if file.stat().st_size > most_bytes:
        raise ValueError(f"{file.stat().st_size} bytes, more than {most_bytes}")
    content = memoryview(file.read_bytes())
    order = _ORDER.get(bytes(content[_PREAMBLE - 2 : _PREAMBLE]))
    if order is None or b"MATLAB 7.3" in bytes(content[:_PREAMBLE]):
        raise ValueError("no file of MATLAB 5 to 7, as save(..., '-v7') writes it")
    names = []
    for kind, body in _elements(content[_PREAMBLE:], order):
        if kind == _COMPRESSED:
            ((_, matrix),) = _elements(_unpacked(body, most_bytes), order)
        else:
            matrix = body
        (_, flags), (_, shape), (_, name), *parts = _elements(matrix, order)
        if bytes(name) == key.encode():
            return _numbers(flags, shape, parts, order)
        names.append(bytes(name).decode("latin-1"))
    raise ValueError(f"only {', '.join(names) or 'nothing'}, no array named {key}")


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Kinds and contents of the elements that follow one another."""
    at = 0
    while at < len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        begin, end = at + 8, len(content)
        at = begin + size if kind == _COMPRESSED else begin + -(-size // 8) * 8
        if kind >> 16:  # a short one: its size and its content are in these eight bytes, too
            kind, size, at = kind & 0xFFFF, kind >> 16, begin
            begin, end = begin - 4, begin
        if begin + size > end:
            raise ValueError(f"an element that ends at {begin + size} of {end} bytes")
        yield kind, content[begin : begin + size]


def _unpacked(content: memoryview, most_bytes: int) -> memoryview:
    unpacker = zlib.decompressobj()
    unpacked = unpacker.decompress(content, most_bytes)
    if not unpacker.eof:
        raise ValueError(f"compressed numbers that break off, or more than {most_bytes} bytes")
    return memoryview(unpacked)


def _numbers(
    flags: memoryview, shape: memoryview, parts: list[tuple[int, memoryview]], order: str
) -> NDArray[Any]:
    (word,) = struct.unpack_from(f"{order}I", flags)
    if word & 0xFF not in _CLASSES or word & _COMPLEX:
        raise ValueError("a variable that is no matrix of real numbers")
    ((kind, content),) = parts
    lengths = np.frombuffer(shape, f"{order}i4").tolist()
    numbers = np.frombuffer(content, order + _NUMBERS[kind])
    if min(lengths) < 0 or math.prod(lengths) != len(numbers):
        raise ValueError(f"shape {tuple(lengths)} of {len(numbers)} numbers")
    return numbers.reshape(lengths, order="F")
