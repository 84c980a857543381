"""One array a file, .npz, .npy or .mat: its shape before its numbers, and chosen rows alone.

A grid of a million users is never held as a whole: of .npy files the rows wanted are read, .npz
files are streamed, and .mat files are read one array at a time. No pickles.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.deepmimo.mat_files import MOST_BYTES, MatArray
from mmwave_env.episodes.deepmimo.npy_files import NpyArray, NpzArray
from mmwave_env.episodes.tables import refuse
from mmwave_env.numerics.arrays import Array

Shape = tuple[int | str, ...]
_READERS: dict[str, type[NpyArray] | type[MatArray]] = {
    ".npz": NpzArray,
    ".npy": NpyArray,
    ".mat": MatArray,
}  # the first there is counts


def find_array(folder: Path, name: str) -> Path:
    """The file of an array in a folder.

    Raises:
        FileNotFoundError: there is none.
    """
    files = [folder / f"{name}{suffix}" for suffix in _READERS]
    for file in files:
        if file.exists():
            return file
    raise FileNotFoundError(
        f"{files[0]}: found no such file in the scenario, nor .npy or .mat, expected one"
    )


def array_shape(file: Path, key: str, shape: Shape) -> tuple[int, ...]:
    """The shape of a key's array, of which nothing but the beginning is read.

    Args:
        file: as of :func:`find_array`.
        key: name of the array.
        shape: expected; a letter stands for any length.

    Raises:
        ValueError: no regular file, nothing that can be read, no real numbers or another shape;
            the message names file and key.
    """
    return _opened(file, key, shape).shape


def read_array(file: Path, key: str, shape: Shape, rows: NDArray[np.int_] | None = None) -> Array:
    """The array of a key, in double precision.

    Args:
        file: as of :func:`find_array`.
        key: name of the array.
        shape: of the whole array; a letter stands for any length.
        rows: (R,) numbers of the rows to read, in any order; None for all.

    Raises:
        ValueError: as of :func:`array_shape`, or more than MOST_BYTES.
    """
    stored = _opened(file, key, shape)
    count = stored.shape[0] if rows is None else len(rows)
    if count * math.prod(stored.shape[1:]) * 8 > MOST_BYTES:
        refuse(file, key, f"{count} rows of {math.prod(stored.shape[1:])} numbers",
               f"at most {MOST_BYTES} bytes in memory: choose users")  # fmt: skip
    with readable(file, key):
        return np.asarray(stored.rows(rows), float)


def _opened(file: Path, key: str, shape: Shape) -> NpyArray | MatArray:
    if not file.is_file():  # a pipe or a device would be waited for
        refuse(file, key, "no regular file", f"a file of numbers, {', '.join(_READERS)}")
    with readable(file, key):
        stored = _READERS[file.suffix](file, key)
    if stored.dtype.kind not in "fiu":
        refuse(file, key, f"type {stored.dtype}", "real numbers")
    fits = len(stored.shape) == len(shape) and all(
        isinstance(length, str) or length == found
        for found, length in zip(stored.shape, shape, strict=True)
    )
    if not fits:
        refuse(file, key, f"shape {stored.shape}", f"shape ({', '.join(map(str, shape))})")
    return stored


@contextmanager
def readable(file: Path, key: str) -> Iterator[None]:
    """One error for a damaged file, for which numpy, zipfile, zlib and scipy have many."""
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"{file}: {key}: found no readable array ({error}), expected an .npz, .npy or .mat "
            "file of numbers"
        ) from error
