"""Trajectories in TUM format, as the tool evo reads them: lines ``t x y z qx qy qz qw``."""

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mmwave_env.io.lookup import quoted
from mmwave_env.logs.lines import line_blocks, number
from mmwave_env.numerics.numbers import Array

COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


class Poses(NamedTuple):
    """Times and positions of a user, without orientations."""

    time_s: Array  # (T,) increasing
    position_m: Array  # (T, 3)


def tum_lines(time_s: Array, position_m: Array) -> str:
    """Return lines of times (T,) and positions (T, 3) in full precision; rotations are 0 0 0 1."""
    rows = np.column_stack([time_s, position_m]).tolist()
    return "".join([f"{t!r} {x!r} {y!r} {z!r} 0 0 0 1\n" for t, x, y, z in rows])


def read_tum(path: Path) -> Poses:
    """Read a trajectory. Orientations must be numbers, but are not returned.

    Raises:
        ValueError: a line is damaged; the message names file and line, and what was expected.
        OSError: the file can't be read.
    """
    poses = (line for line in _lines(path) if not line.lstrip().startswith("#") and line.strip())
    first = next(poses, None)
    if first is None:
        raise ValueError(f"{path}: found no line with a pose, expected lines {' '.join(COLUMNS)}")
    try:
        rows = np.loadtxt(chain([first], poses), comments="#", ndmin=2, encoding=None)
    except ValueError as error:
        raise _damage(path) from error
    sound = rows.shape[1] == len(COLUMNS) and np.isfinite(rows).all()
    if not sound or not (np.diff(rows[:, 0]) > 0.0).all():
        raise _damage(path)
    return Poses(rows[:, 0].copy(), rows[:, 1:4].copy())


def _lines(path: Path) -> Iterator[str]:
    return chain.from_iterable(lines for lines, _ in line_blocks(path))


def _damage(path: Path) -> ValueError:
    """Return the error about the first damaged line."""
    last_s = -math.inf
    for n, line in enumerate(_lines(path), start=1):
        words = line.split("#")[0].split()
        place = f"{path}, line {n}"
        if not words:
            continue
        if len(words) != len(COLUMNS) or "\r" in line:
            expected = f"{len(COLUMNS)} numbers: {' '.join(COLUMNS)}"
            return ValueError(f"{place}: found {quoted(line)}, expected {expected}")
        for name, word in zip(COLUMNS, words, strict=True):
            if not math.isfinite(number(word)):
                return ValueError(
                    f"{place}, {name}: found {quoted(word)}, expected a finite number"
                )
        time_s = float(words[0])
        if time_s <= last_s:
            return ValueError(f"{place}, t: found {words[0]}, expected more than {last_s}")
        last_s = time_s
    return ValueError(f"{path}: found unreadable text, expected lines {' '.join(COLUMNS)}")
