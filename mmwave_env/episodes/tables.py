"""CSV files of numbers, read column by column; errors name the file, the line and the column."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from mmwave_env.numerics.arrays import Array

TRAJECTORY = ("t", "x", "y", "z", "vx", "vy", "vz")  # columns of where a user was when


def refuse(file: Path, what: str, found: object, expected: str) -> NoReturn:
    """Raise the ValueError that readers of files raise."""
    raise ValueError(f"{file}: {what}: found {found}, expected {expected}")


def read_table(
    file: Path, needed: Sequence[str], optional: Sequence[str] = ()
) -> tuple[list[int], Array]:
    """The lines (N,) of a table's rows in its file, and its columns (N, columns).

    Args:
        file: CSV with a header. Columns may stand in any order; others are not looked at.
        needed: names of columns.
        optional: names of columns that are there all together or not at all.

    Raises:
        ValueError: naming file, line and column.
        FileNotFoundError: there is no such file.
    """
    (_, header), *rows = _rows(file)
    names = [*needed, *(optional if any(name in header for name in optional) else ())]
    if any(name not in header for name in names):
        refuse(file, "header", repr(",".join(header)), f"the columns {','.join(names)}")
    columns = {name: header.index(name) for name in names}
    values = np.empty((len(rows), len(names)))
    for i, (line, row) in enumerate(rows):
        if len(row) != len(header):
            refuse(file, f"line {line}", f"{len(row)} values", f"{len(header)}")
        values[i] = [_number(file, f"line {line}, column {n}", row[c]) for n, c in columns.items()]
    return [line for line, _ in rows], values


def columns_of(file: Path) -> list[str]:
    """The names in the header of a table.

    Raises:
        ValueError: no CSV.
        FileNotFoundError: there is no such file.
    """
    return _rows(file)[0][1]


def _rows(file: Path) -> list[tuple[int, list[str]]]:
    """Lines of a CSV file that are not empty, with their numbers; the first is the header."""
    if not file.is_file():
        raise FileNotFoundError(f"{file}: found no such file, expected CSV")
    try:
        with file.open(newline="", encoding="utf-8-sig") as lines:
            reader = csv.reader(lines, skipinitialspace=True)
            return [(reader.line_num, row) for row in reader if row] or [(1, [])]
    except (ValueError, OSError, csv.Error) as error:
        raise ValueError(f"{file}: found no readable CSV ({error}), expected CSV") from error


def _number(file: Path, what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        refuse(file, what, repr(text), "a finite number")
    return value
