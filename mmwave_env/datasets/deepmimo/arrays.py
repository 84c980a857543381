"""Arrays of a DeepMIMO v4 scenario: each is in a .npz or .npy file, and pickles are refused."""

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
SUFFIXES = (".npz", ".npy")  # in the order of preference
MOST_BYTES = 2**29  # most bytes of an array in memory


def find_array(folder: Path, name: str) -> Path:
    """Return the file of an array in a folder.

    Raises:
        FileNotFoundError: there is no such file.
    """
    files = [folder / f"{name}{suffix}" for suffix in SUFFIXES]
    for file in files:
        if file.exists():
            return file
    matlab = f"{name}.mat alone" if (folder / f"{name}.mat").exists() else "no such file"
    raise FileNotFoundError(
        f"{files[0]}: found {matlab}, expected .npz or .npy, as DeepMIMO 4 writes them"
    )


def read_array(file: Path, key: str, shape: Shape, rows: NDArray[np.int_] | None = None) -> Array:
    """Read the array of a key in double precision.

    Args:
        file: file of the array, as :func:`find_array` returns it.
        key: name of the array.
        shape: shape of the whole array; a letter stands for any length.
        rows: (R,) numbers of the rows to read, in any order; None for all. Other rows of an
            .npy file are not read.

    Raises:
        ValueError: the file is not regular, not readable, not of real numbers, of another shape
            or larger than MOST_BYTES; the message names file and key.
    """
    if not file.is_file():  # reading a pipe or a device would block
        refuse_in(file, key, "no regular file", f"a file of numbers, {', '.join(SUFFIXES)}")
    with _readable(file, key):
        stored = _stored(file, key)
    if stored.dtype.kind not in "fiu":
        refuse_in(file, key, f"type {stored.dtype}", "real numbers")
    pairs = zip(shape, stored.shape, strict=False)
    wanted = tuple(n if isinstance(length, str) else length for length, n in pairs)
    if len(shape) != stored.ndim or stored.shape != wanted:
        refuse_in(file, key, f"shape {stored.shape}", f"shape ({', '.join(map(str, shape))})")
    count, width = len(stored if rows is None else rows), math.prod(stored.shape[1:])
    if count * width * 8 > MOST_BYTES:
        expected = f"at most {MOST_BYTES} bytes in memory: choose users"
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
            raise ValueError(f"only {', '.join(names[:5]) or 'nothing'}, no array named {key}")
        size = archive.getinfo(f"{key}.npy").file_size
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes, more than {MOST_BYTES}: an .npy file may be larger")
    with np.load(file, allow_pickle=False) as arrays:
        return np.asarray(arrays[key])


@contextmanager
def _readable(file: Path, key: str) -> Iterator[None]:
    """Turn all errors of numpy, zipfile and zlib for a damaged file into a ValueError."""
    try:
        yield
    except Exception as error:
        raise ValueError(
            f"{file}: {key}: found no readable array ({' '.join(str(error).split())}), expected an "
            ".npz or .npy file of numbers"
        ) from error
