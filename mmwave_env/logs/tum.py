"""Trajectories in TUM format, as evo reads them: lines ``t x y z qx qy qz qw``."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, NoReturn

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
    """Return lines of times (T,) and positions (T, 3), bit-exact, with identity orientation."""
    rows = np.column_stack([time_s, position_m]).tolist()
    return "".join([f"{t!r} {x!r} {y!r} {z!r} 0 0 0 1\n" for t, x, y, z in rows])


def tum_blocks(path: Path) -> Iterator[Poses]:
    """Read a trajectory, about 1 MiB of the file at a time; each block has at least one pose.

    Orientations must be numbers, but are not returned.

    Raises:
        ValueError: a line is damaged; the message names file and line, and what was expected.
        OSError: the file can't be read.
    """
    first, last = 1, -math.inf
    for lines, _ in line_blocks(path):
        track = _parse(path, lines, first, last)
        first += len(lines)
        if len(track):
            last = track[-1, 0]
            yield Poses(track[:, 0].copy(), track[:, 1:].copy())
    if last == -math.inf:
        raise ValueError(f"{path}: found no line with a pose, expected {' '.join(COLUMNS)}")


def _parse(path: Path, lines: list[str], first: int, last_s: float) -> Array:
    """Return the times and positions (lines, 4) in lines; refuse damaged lines.

    ``first`` is the number of the first line. Its time must be later than ``last_s``.
    """
    poses = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not poses:
        return np.empty((0, 4))
    try:
        rows = np.loadtxt(poses, comments="#", ndmin=2, encoding=None)
    except ValueError:
        rows = np.empty((0, 0))
    times = np.concatenate([[last_s], rows[:, :1].ravel()])
    if rows.shape[1] != len(COLUMNS) or not np.isfinite(rows).all() or (np.diff(times) <= 0).any():
        _find_damage(path, lines, first, last_s)
    return rows[:, :4]


def _find_damage(path: Path, lines: list[str], first: int, last_s: float) -> NoReturn:
    """Refuse lines, naming the first damaged line."""
    for n, line in enumerate(lines, start=first):
        words, place = line.split("#")[0].split(), f"{path}, line {n}"
        if words and len(words) != len(COLUMNS):
            raise ValueError(
                f"{place}: found {len(words)} numbers, expected {len(COLUMNS)}: {' '.join(COLUMNS)}"
            )
        for name, word in zip(COLUMNS, words, strict=False):
            if not math.isfinite(number(word)):
                raise ValueError(f"{place}, {name}: found {quoted(word)}, expected a finite number")
        if words and not float(words[0]) > last_s:
            raise ValueError(f"{place}, t: found {words[0]}, expected more than {last_s}")
        last_s = float(words[0]) if words else last_s
    raise ValueError(
        f"{path}, lines {first} to {first + len(lines) - 1}: found text that numpy can't read, "
        f"expected {' '.join(COLUMNS)}"
    )
