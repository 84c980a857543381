"""Reader of arrays in .npz and .npy files of DeepMIMO v4 scenarios; it refuses pickled objects."""

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.world.checks import refuse_in

Shape = tuple[int | str, ...]
SUFFIXES = (".npz", ".npy")  # in the order of preference
MOST_BYTES = 2**29  # maximum size of an array in memory


def find_array(folder: Path, name: str) -> Path:
    """Return the file of an array in a folder.

    Raises:
        FileNotFoundError: there is no such file.
    """
    files = [folder / f"{name}{suffix}" for suffix in SUFFIXES]
    for file in files:
        if file.exists():
            return file
    raise FileNotFoundError(
        f"{files[0]}: found no such file, expected an .npz or .npy file, as DeepMIMO 4 writes it"
    )


def read_array(file: Path, key: str, shape: Shape, rows: Index | None = None) -> Array:
    """Read, as doubles, the array stored under a key in a file that :func:`find_array` found.

    Args:
        file, key: the file, and the name of the array.
        shape: shape of the complete array; a letter stands for any length.
        rows: (R,) indices of the rows to return, in any order; None for all. Of an .npy file, only
            these rows are read.

    Raises:
        ValueError: the path is not a regular file, or the array can't be read, has numbers that
            are not real, has another shape or is larger than MOST_BYTES; the message names file
            and key.
    """
    if not file.is_file():  # reading a pipe or a device would block
        refuse_in(file, key, "a path that is not a file", f"a file, {' or '.join(SUFFIXES)}")
    with _readable(file, key):
        stored = _stored(file, key)
    if stored.dtype.kind not in "fiu":
        refuse_in(file, key, f"type {stored.dtype}", "real numbers")
    pairs = zip(shape, stored.shape, strict=False)
    wanted = tuple(n if isinstance(length, str) else length for length, n in pairs)
    if len(shape) != stored.ndim or stored.shape != wanted:
        refuse_in(file, key, f"shape {stored.shape}", f"shape ({', '.join(map(str, shape))})")
    count = len(stored if rows is None else rows)
    width = math.prod(stored.shape[1:])
    if count * width * 8 > MOST_BYTES:
        expected = f"at most {MOST_BYTES} bytes in memory: choose fewer users"
        refuse_in(file, key, f"{count} rows of {width} numbers", expected)
    with _readable(file, key):
        return np.array(stored if rows is None else stored[rows], float)


def _stored(file: Path, key: str) -> NDArray[Any]:
    """Return the array as it is stored; the array of an .npy file stays on disk."""
    if file.suffix == ".npy":
        return np.asanyarray(np.lib.format.open_memmap(file, mode="r"))
    with zipfile.ZipFile(file) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if key not in names:
            raise ValueError(f"the file has {', '.join(names[:5]) or 'nothing'}, but not {key}")
        size = archive.getinfo(f"{key}.npy").file_size
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes, more than {MOST_BYTES}: use an .npy file instead")
    with np.load(file, allow_pickle=False) as arrays:
        return np.asarray(arrays[key])


@contextmanager
def _readable(file: Path, key: str) -> Iterator[None]:
    """Convert every error that numpy, zipfile or zlib raises for a damaged file to a ValueError."""
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"{file}: {key}: found no readable array ({' '.join(str(error).split())}), expected an "
            ".npz or .npy file of numbers"
        ) from error
