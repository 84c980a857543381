"""CSV files of numbers, read column by column; errors name the file, the line and the column."""

import csv
import math
from array import array
from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import NoReturn

import numpy as np

from mmwave_env.files import read_text
from mmwave_env.lookup import quoted
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
        OSError: it can't be read; FileNotFoundError where there is no such file.
    """
    rows = _rows(file)
    try:
        _, header = next(rows, (1, []))
        names = [*needed, *(optional if any(name in header for name in optional) else ())]
        if any(name not in header for name in names):
            refuse(file, "header", quoted(",".join(header)), f"the columns {','.join(names)}")
        columns = {name: header.index(name) for name in names}
        lines: list[int] = []
        values = array("d")  # takes a fraction of what the rows would as text
        for line, row in rows:
            if len(row) != len(header):
                refuse(file, f"line {line}", f"{len(row)} values", f"{len(header)}")
            values.extend(_numbers(file, line, {n: row[c] for n, c in columns.items()}))
            lines.append(line)
    except csv.Error as error:
        raise ValueError(f"{file}: found no readable CSV ({error}), expected CSV") from error
    return lines, np.array(values).reshape(len(lines), len(names))


def columns_of(file: Path) -> list[str]:
    """The names in the header of a table.

    Raises:
        ValueError: no CSV.
        OSError: it can't be read; FileNotFoundError where there is no such file.
    """
    try:
        return next(_rows(file), (1, []))[1]
    except csv.Error as error:
        raise ValueError(f"{file}: found no readable CSV ({error}), expected CSV") from error


def _rows(file: Path) -> Iterator[tuple[int, list[str]]]:
    """Lines of a CSV file that are not empty, with their numbers; the first is the header."""
    reader = csv.reader(StringIO(read_text(file, "CSV"), newline=""), skipinitialspace=True)
    yield from ((reader.line_num, row) for row in reader if row)


def _numbers(file: Path, line: int, cells: Mapping[str, str]) -> list[float]:
    """The numbers in the cells of a line, by column."""
    found = []
    for name, text in cells.items():
        try:
            found.append(float(text))
        except ValueError:
            found.append(math.nan)
        if not math.isfinite(found[-1]):
            refuse(file, f"line {line}, column {name}", quoted(text), "a finite number")
    return found
