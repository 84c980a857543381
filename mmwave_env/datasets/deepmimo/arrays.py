"""Arrays of a DeepMIMO v4 scenario: one in each .npz or .npy file, and never a pickle."""

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.numerics.numbers import Array
from mmwave_env.world.checks import refuse_in

Shape = tuple[int | str, ...]
SUFFIXES = (".npz", ".npy")  # the first there is counts
MOST_BYTES = 2**29  # of an array in memory


def find_array(folder: Path, name: str) -> Path:
    """The file of an array in a folder.

    Raises:
        FileNotFoundError: there is none.
    """
    files = [folder / f"{name}{suffix}" for suffix in SUFFIXES]
    for file in files:
        if file.exists():
            return file
    raise FileNotFoundError(
        f"{files[0]}: found no such file in the scenario, nor .npy, expected one"
    )


def read_array(file: Path, key: str, shape: Shape, rows: NDArray[np.int_] | None = None) -> Array:
    """The array of a key, in double precision.

    Args:
        file: as of :func:`find_array`.
        key: name of the array.
        shape: of the whole array; a letter stands for any length.
        rows: (R,) numbers of the rows to read, in any order; None for all. Of an .npy file the
            others are not read.

    Raises:
        ValueError: no regular file, nothing that can be read, no real numbers, another shape, or
            more than MOST_BYTES; the message names file and key.
    """
    if not file.is_file():  # a pipe or a device would be waited for
        refuse_in(file, key, "no regular file", f"a file of numbers, {', '.join(SUFFIXES)}")
    with _readable(file, key):
        stored = _stored(file, key)
    if stored.dtype.kind not in "fiu":
        refuse_in(file, key, f"type {stored.dtype}", "real numbers")
    fits = len(stored.shape) == len(shape) and all(
        isinstance(length, str) or length == found
        for found, length in zip(stored.shape, shape, strict=True)
    )
    if not fits:
        refuse_in(file, key, f"shape {stored.shape}", f"shape ({', '.join(map(str, shape))})")
    count, width = len(stored if rows is None else rows), math.prod(stored.shape[1:])
    if count * width * 8 > MOST_BYTES:
        expected = f"at most {MOST_BYTES} bytes in memory: choose users"
        refuse_in(file, key, f"{count} rows of {width} numbers", expected)
    with _readable(file, key):
        return np.array(stored if rows is None else stored[rows], float)


def _stored(file: Path, key: str) -> NDArray[Any]:
    """The array as it is stored; of an .npy file it stays on disk."""
    if file.suffix == ".npy":
        return np.asanyarray(np.lib.format.open_memmap(file, mode="r"))
    with zipfile.ZipFile(file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if key not in names:
            raise ValueError(f"only {', '.join(names[:5]) or 'nothing'}, no array named {key}")
        size = archive.getinfo(f"{key}.npy").file_size
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes, more than {MOST_BYTES}: an .npy file may be larger")
    with np.load(file, allow_pickle=False) as arrays:
        return np.asarray(arrays[key])


@contextmanager
def _readable(file: Path, key: str) -> Iterator[None]:
    """One error for a damaged file, for which numpy, zipfile and zlib have many."""
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"{file}: {key}: found no readable array ({' '.join(str(error).split())}), expected an "
            ".npz or .npy file of numbers"
        ) from error
