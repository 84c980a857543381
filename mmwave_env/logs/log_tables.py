"""Measurement logs as tables of numbers, the same for CSV and Parquet.

A table is a few thousand consecutive rows. Only the names of the columns, the shape of the file
and whether cells are numbers are checked here; `log.py` interprets the numbers.
"""

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.io.files import naming, open_regular
from mmwave_env.io.lookup import quoted
from mmwave_env.logs.lines import DamagedFileError, line_blocks, number
from mmwave_env.logs.log_columns import Column, columns_of
from mmwave_env.numerics.numbers import Array

Rows = NDArray[np.int64]

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_BATCH_ROWS = 1 << 14
_NOT_A_NUMBER = "expected a number, or nothing where it was not measured"


class LogError(ValueError):
    """A file that is not a measurement log, or is damaged from some row on."""


class Table(NamedTuple):
    """Consecutive rows of a log."""

    cells: Array  # (quantities, n) as in the file, NaN where empty
    rows: Rows  # (n,) numbers of the rows, for messages
    share: float  # share of the file read so far, 0 to 1
    # the damage of the last row, after which nothing follows; cells of that row that can't be
    # read are NaN
    damage: LogError | None = None


@dataclass(frozen=True)
class LogFile:
    """A log whose header was read."""

    path: Path  # path of the file
    # the columns that are used, by quantity; the rows of tables are in this order
    columns: dict[str, Column]
    width: int  # number of columns in the file

    def error(self, row: int, quantity: str, found: str, expected: str) -> LogError:
        """Return the error that names a cell; rows of a CSV count as editors count lines."""
        where = f"{'row' if _is_parquet(self.path) else 'line'} {row}"
        if quantity:
            where += f", column {self.columns[quantity].name!r}"
        return LogError(f"{self.path}, {where}: found {found}, {expected}")

    def tables(self) -> Iterator[Table]:
        """Yield the rows in order, up to the first table with damage."""
        return _parquet_tables(self) if _is_parquet(self.path) else _csv_tables(self)


def open_log(
    path: Path, hz_per_mps: float, odometry: bool = True, associated: bool = True
) -> LogFile:
    """Read the header of a log.

    Args:
        path: path of a CSV (plain or gzipped) or Parquet file.
        hz_per_mps: f_c / c, for Doppler shifts given in m/s.
        odometry: False to ignore the columns of odometry.
        associated: False where rows are paths: a column of anchors is ignored.

    Raises:
        LogError: the file is of another format, or its columns are not those of a log.
        OSError: the file can't be read.
    """
    if not path.name.lower().endswith(SUFFIXES):
        raise LogError(f"{path}: found {path.suffix!r}, expected a name in {', '.join(SUFFIXES)}")
    with open_regular(path, "a measurement log") as file, naming(path):
        if not file.read(1):
            raise LogError(f"{path}: found an empty file, expected a measurement log")
    names = list(_parquet_types(path)) if _is_parquet(path) else _csv_names(path)
    try:
        columns = columns_of(names, hz_per_mps, odometry, associated)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error
    log = LogFile(path, columns, len(names))
    if _is_parquet(path):
        _require_numbers(log)
    return log


def _is_parquet(path: Path) -> bool:
    return path.suffix.lower() == ".parquet"


# --- CSV


def _csv_names(path: Path) -> list[str]:
    try:
        block = next(line_blocks(path), None)
    except DamagedFileError as error:
        raise LogError(str(error)) from error
    if block is None:
        raise LogError(f"{path}: found an empty file, expected a measurement log")
    try:  # by a real CSV reader, because some programs quote names
        names = [name.strip() for name in next(csv.reader(block.lines[:1]))]
    except csv.Error:
        names = []
    if len(names) < 2:
        raise LogError(
            f"{path}, line 1: found {block.lines[0][:60]!r}, expected names of columns, divided "
            "by commas"
        )
    return names


def _csv_tables(log: LogFile) -> Iterator[Table]:
    order = list(log.columns.values())
    try:
        for block in line_blocks(log.path):
            skip = 1 if block.first == 1 else 0  # the header
            lines = block.lines[skip:]
            first = block.first + skip
            cells = _parse_quickly(lines, order, log.width)
            if cells is None:
                table = _parse_carefully(log, lines, first, block.share)
            else:
                table = Table(cells, np.arange(first, first + len(lines)), block.share)
            yield table
            if table.damage:
                return
    except DamagedFileError as error:
        yield Table(
            np.full((len(order), 1), np.nan), np.array([error.line]), 1.0, LogError(str(error))
        )


def _parse_quickly(lines: list[str], columns: list[Column], width: int) -> Array | None:
    """Parse cells (quantities, lines); return None where a line needs a closer look."""
    if not lines:
        return np.empty((len(columns), 0))
    if any(line.count(",") != width - 1 for line in lines):
        return None
    text = "\n" + "\n".join(lines) + "\n"
    for empty, filled in ((",,", ",nan,"), (",,", ",nan,"), ("\n,", "\nnan,"), (",\n", ",nan\n")):
        text = text.replace(empty, filled)
    try:
        cells = np.loadtxt(text[1:-1].split("\n"), delimiter=",", comments=None, ndmin=2,
                           usecols=[c.place for c in columns], encoding=None)  # fmt: skip
    except ValueError:
        return None
    return np.ascontiguousarray(cells.T) if len(cells) == len(lines) else None


def _parse_carefully(log: LogFile, lines: list[str], first: int, share: float) -> Table:
    """Parse cell by cell up to the first damage; skip blank lines; blank cells are empty."""
    cells, rows, damage = [], [], None
    for row, line in enumerate(lines, start=first):
        if not line.strip():
            continue
        words = line.split(",")
        values = [math.nan] * len(log.columns)
        if len(words) != log.width:
            count = f"{len(words)} cells" if len(words) > 1 else f"one cell, {line[:40]!r}"
            damage = log.error(row, "", count, f"expected {log.width}, as in the header")
        else:
            for i, (quantity, column) in enumerate(log.columns.items()):
                word = words[column.place].strip()
                values[i] = number(word)
                empty = not word or word.lower().lstrip("+-") == "nan"
                if damage is None and math.isnan(values[i]) and not empty:
                    damage = log.error(row, quantity, quoted(word), _NOT_A_NUMBER)
        cells.append(values)
        rows.append(row)
        if damage:
            break
    shape = (len(rows), len(log.columns))
    return Table(np.array(cells, float).reshape(shape).T, np.array(rows, np.int64), share, damage)


# --- Parquet


def require_arrow(path: Path) -> tuple[Any, Any]:
    """Return pyarrow and its Parquet module, or refuse if they are not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise LogError(f'{path}: Parquet needs pyarrow: pip install "mmwave-loc[data]"') from error
    return pyarrow, pyarrow.parquet


def _open_parquet(path: Path) -> Any:
    pyarrow, parquet = require_arrow(path)
    try:
        # Buffered, because otherwise a row group of a million rows would be in memory at once.
        return parquet.ParquetFile(
            path, buffer_size=1 << 20, pre_buffer=False, page_checksum_verification=True
        )
    except (OSError, pyarrow.ArrowException) as error:
        raise LogError(f"{path}: found no readable Parquet ({error}), expected Parquet") from error


def _parquet_types(path: Path) -> dict[str, Any]:
    """Return the names of the columns with their types."""
    try:
        with _open_parquet(path) as file:
            return {field.name: field.type for field in file.schema_arrow}
    except UnicodeDecodeError as error:
        expected = "names of columns in UTF-8"
        raise LogError(f"{path}: found {error.object[:40]!r}, expected {expected}") from error


def _require_numbers(log: LogFile) -> None:
    types, found = require_arrow(log.path)[0].types, _parquet_types(log.path)
    numeric = types.is_floating, types.is_integer, types.is_decimal, types.is_null
    for column in log.columns.values():
        if not any(is_kind(found[column.name]) for is_kind in numeric):
            where = f"{log.path}, column {column.name!r}"
            raise LogError(f"{where}: found type {found[column.name]}, expected numbers")


def _parquet_tables(log: LogFile) -> Iterator[Table]:
    pyarrow, _ = require_arrow(log.path)
    names = [column.name for column in log.columns.values()]
    with _open_parquet(log.path) as file:
        total, done = max(file.metadata.num_rows, 1), 0
        batches = file.iter_batches(_BATCH_ROWS, columns=names, use_threads=False)
        while True:
            try:
                batch = next(batches, None)
                if batch is None:
                    return
                cells = np.array([
                    batch.column(name).cast(pyarrow.float64(), safe=False)
                    .to_numpy(zero_copy_only=False)
                    for name in names
                ])  # fmt: skip
            except (OSError, pyarrow.ArrowException) as error:
                damage = log.error(
                    done + 1, "", f"broken Parquet data ({error})", "expected a file that is whole"
                )
                nothing = np.full((len(names), 1), np.nan)
                yield Table(nothing, np.array([done + 1]), done / total, damage)
                return
            rows = np.arange(done + 1, done + 1 + cells.shape[1])
            done += cells.shape[1]
            yield Table(cells, rows, done / total)
