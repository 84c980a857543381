"""Trajectories in TUM format, as the tool evo reads them: lines ``t x y z qx qy qz qw``."""

import math
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mmwave_env.io.lookup import quoted
from mmwave_env.logs.lines import number, read_lines
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

    Of several poses at one time, the first is returned; a warning counts the others.

    Raises:
        ValueError: a line is damaged; the message names file and line, and what was expected.
        OSError: the file can't be read, or needs more memory than there is.
    """
    lines, damage = read_lines(path)
    rows: list[list[float]] = []
    repeated = []
    for n, line in enumerate(lines, start=1):
        words = line.split("#")[0].split()
        place = f"{path}, line {n}"
        if not words:
            continue
        if len(words) != len(COLUMNS) or "\r" in line:
            raise ValueError(
                f"{place}: found {quoted(line)}, expected {len(COLUMNS)} numbers: "
                f"{' '.join(COLUMNS)}"
            )
        row = [number(word) for word in words]
        for name, word, value in zip(COLUMNS, words, row, strict=True):
            if not math.isfinite(value):
                raise ValueError(f"{place}, {name}: found {quoted(word)}, expected a finite number")
        if rows and row[0] == rows[-1][0]:
            repeated.append(place)
            continue
        if rows and row[0] < rows[-1][0]:
            raise ValueError(f"{place}, t: found {words[0]}, expected more than {rows[-1][0]}")
        rows.append(row)
    if damage or not rows:
        problem = damage or "no line with a pose"
        raise ValueError(f"{path}: found {problem}, expected lines {' '.join(COLUMNS)}")
    if repeated:
        warnings.warn(
            f"{repeated[0]}: found the time of the pose before; such poses, left out: "
            f"{len(repeated)}",
            stacklevel=2,
        )
    poses = np.array(rows)
    return Poses(poses[:, 0].copy(), poses[:, 1:4].copy())
