"""numpy's files, .npy and .npz: chosen rows, read on from the first byte to the last.

What a header claims is held against what lies in the file before anything is allocated for it.
"""

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

_BLOCK = 2**20  # bytes; as much is held beside the rows wanted
_LONGEST_HEADER = 2**14  # bytes
_DEFLATE = 1032  # bytes that one compressed byte can stand for
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class NpyArray:
    """The array of an .npy file.

    Args:
        path: of the file.

    Attributes:
        shape, dtype: of the array.

    Raises:
        Exception: of many kinds: not such a file, or one that is shorter than it claims.
    """

    def __init__(self, path: Path, key: str) -> None:
        self.path, self.key = path, key
        with self._opened() as stream:
            head = BytesIO(stream.read(_LONGEST_HEADER))  # whatever length it claims
        version = npy.read_magic(head)
        if version not in _HEADERS:
            raise ValueError(f"version {version} of the .npy format, which is not one of numbers")
        self.shape, self._by_column, self.dtype = _HEADERS[version](head)
        self._first = head.tell()
        size = self._first + math.prod(self.shape) * self.dtype.itemsize
        if min(self.shape, default=0) < 0 or size > self._most_bytes():
            raise ValueError(f"shape {self.shape}, and no more than {self._most_bytes()} bytes")

    @contextmanager
    def _opened(self) -> Iterator[IO[bytes]]:
        with self.path.open("rb") as stream:
            yield stream

    def _most_bytes(self) -> int:
        return self.path.stat().st_size

    def rows(self, wanted: NDArray[np.int_] | None) -> NDArray[Any]:
        """Rows (R, ...) by their numbers (R,), in any order; None for all.

        An array that is stored by rows is one column of long items; one that is stored by columns
        (Fortran's order) is many columns of single numbers.
        """
        N, rest = self.shape[0], self.shape[1:]
        columns, items = (math.prod(rest), 1) if self._by_column else (1, math.prod(rest))
        runs, place = ([(0, 0, N)], slice(None)) if wanted is None else _runs(wanted)
        count = sum(length for _, _, length in runs)
        picked = np.empty((columns, count, items), self.dtype)
        with self._opened() as stream:
            forward = _Forward(stream)
            for column in range(columns):
                for at, row, length in runs:
                    item = (column * N + row) * items
                    forward.skip_to(self._first + item * self.dtype.itemsize)
                    forward.fill(picked[column, at : at + length])
            forward.finish()
        order: Any = "F" if self._by_column else "C"
        table = picked.transpose(1, 0, 2).reshape(count, *rest, order=order)
        return np.asarray(table[place])


class NpzArray(NpyArray):
    """The array named ``key`` in an .npz file; else as :class:`NpyArray`."""

    def __init__(self, path: Path, key: str) -> None:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if f"{key}.npy" not in names:
                found = ", ".join(name.removesuffix(".npy") for name in names[:5])
                raise ValueError(f"only {found or 'nothing'}, no array named {key}")
            self._member = archive.getinfo(f"{key}.npy")
        if self._member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"compression {self._member.compress_type}, which numpy never writes")
        super().__init__(path, key)

    @contextmanager
    def _opened(self) -> Iterator[IO[bytes]]:
        with zipfile.ZipFile(self.path) as archive, archive.open(self._member) as stream:
            yield stream

    def _most_bytes(self) -> int:
        stored = min(self._member.compress_size, self.path.stat().st_size)
        return min(self._member.file_size, _DEFLATE * stored)


def _runs(wanted: NDArray[np.int_]) -> tuple[list[tuple[int, int, int]], NDArray[np.int_]]:
    """Rows in the order of the file, and where each of those wanted is among them.

    They are runs of rows that follow each other: how many come before, the first row, how many.
    """
    rows, place = np.unique(wanted, return_inverse=True)
    starts = np.flatnonzero(np.diff(rows, prepend=-2) != 1)
    lengths = np.diff(starts, append=len(rows))
    return list(zip(starts.tolist(), rows[starts].tolist(), lengths.tolist(), strict=True)), place


class _Forward:
    """A stream that is read on, in blocks."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream, self._at = stream, 0

    def skip_to(self, offset: int) -> None:
        if not isinstance(self._stream, zipfile.ZipExtFile):
            self._at = self._stream.seek(offset)
        while self._at < offset:
            self._read(offset - self._at)

    def fill(self, array: NDArray[Any]) -> None:
        """Fill an array, contiguous."""
        into = array.reshape(-1).view(np.uint8).data
        while into:
            block = self._read(len(into))
            into[: len(block)] = block
            into = into[len(block) :]

    def finish(self) -> None:
        """Read an archive on to its end, where its checksum is compared."""
        while isinstance(self._stream, zipfile.ZipExtFile) and self._stream.read(_BLOCK):
            pass

    def _read(self, count: int) -> bytes:
        block = self._stream.read(min(count, _BLOCK))
        if not block:
            raise EOFError("it ends before its last number")
        self._at += len(block)
        return block
