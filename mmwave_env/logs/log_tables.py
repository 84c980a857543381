"""Measurement logs as tables of numbers, read from CSV or Parquet.

This module checks only the names of the columns, the number of cells in a row, and that cells are
numbers; ``log_checks.py`` checks the numbers.
"""

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mmwave_env.io.files import open_regular
from mmwave_env.io.lookup import quoted
from mmwave_env.logs.lines import DamagedFileError, line_blocks, number
from mmwave_env.logs.log_columns import BODY, STATION, Column, columns_of
from mmwave_env.numerics.numbers import Array, Index

AnyArrays = TypeVar("AnyArrays", bound="Arrays")

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_BATCH_ROWS = 1 << 14
_ROW_BYTES = 1000  # memory for a row of a log, and for its part in the track
_NUMBER = "a number, or nothing if it was not measured"
_ANCHOR = "the number of an anchor in the scene (1: the base station)"


class LogError(ValueError):
    """Error for a file that is not a measurement log, or that is damaged from some row on."""


@dataclass(frozen=True, eq=False)
class Arrays:
    """Base dataclass of n rows or epochs: arrays (n, ...), and values shared by all n."""

    def arrays(self) -> dict[str, Array]:
        """Return the arrays by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def __len__(self) -> int:
        return len(next(iter(self.arrays().values())))

    def part(self: AnyArrays, rows: slice) -> AnyArrays:
        """Return only these rows or epochs."""
        return replace(self, **{name: values[rows] for name, values in self.arrays().items()})

    @classmethod
    def joined(cls, parts: Sequence[AnyArrays]) -> AnyArrays:
        """Join consecutive parts; shared values are taken from the last part."""
        last = parts[-1]
        if len(parts) == 1:
            return last
        names = last.arrays()
        return replace(last, **{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


@dataclass(frozen=True, eq=False)
class Table(Arrays):
    """Rows of a log: all rows of a file, or those up to the first damage."""

    columns: dict[str, Column]  # the columns that are used, by quantity
    rows: Index  # (n,) row numbers in the file, for messages
    cells: Array  # (n, columns) as in the file, NaN where empty
    # damage in the last row, which ends the log; cells of that row that can't be read are NaN
    damage: LogError | None = None

    def raw(self, quantity: str) -> Array:
        """Return the cells (n,) of a quantity as in the file."""
        return self.cells[:, list(self.columns).index(quantity)]  # type: ignore[no-any-return]

    def __getitem__(self, quantity: str) -> Array:
        """Return the values (n,) of a quantity in SI units and dB; NaN if the log lacks it."""
        if quantity not in self.columns:
            return np.full(len(self), np.nan)
        return self.columns[quantity].unit.convert(self.raw(quantity))  # type: ignore[no-any-return]

    @cached_property
    def starts(self) -> Index:
        """Return the index (epochs,) of every epoch's first row; rows of an epoch have one time."""
        # Compare times in the file's unit: different times may become equal in seconds.
        time = self.raw("time")
        return np.flatnonzero(np.append(True, np.diff(time) != 0.0)[: len(time)])

    @cached_property
    def epoch(self) -> Index:
        """Return every row's epoch (n,), counted from 0."""
        return np.repeat(np.arange(len(self.starts)), np.diff(self.starts, append=len(self)))

    def first(self, values: Array) -> Array:
        """Return each epoch's first number (epochs,) in ``values`` (n,); NaN if all are NaN."""
        first = np.full(len(self.starts), np.nan)
        some = np.flatnonzero(~np.isnan(values))[::-1]
        first[self.epoch[some]] = values[some]  # backwards, so that the first row's value remains
        return first

    def links(self) -> Array:
        """Return (n, 4) ranges (m) and angles (rad); azimuths of departure are in the map's frame.

        An azimuth of arrival is that of the line from the anchor to the user; for a mirror image in
        a log with a column :data:`STATION`, it is the azimuth measured at the base station instead.
        """
        arrival = self[STATION if STATION in self.columns else "aoa_azimuth"]
        departure = self["aod_azimuth"]
        if BODY in self.columns:  # departures are NaN in epochs without a heading
            departure = self[BODY] + self.first(self["heading"])[self.epoch]
        return np.column_stack([self["toa"], arrival, self["aoa_elevation"], departure])


@dataclass(frozen=True)
class LogFile:
    """A log of which only the header was read."""

    path: Path  # path of the file
    columns: dict[str, Column]  # the columns that are used, by quantity
    width: int  # number of columns in the file
    clock: bool = False  # whether the user's clock has an offset, so that ranges may be negative
    delimiter: str = ","  # character between the cells of a CSV file

    def error(self, row: int, quantity: str, problem: str, expected: str) -> LogError:
        """Return an error that names a cell; in a CSV file, the row number is the line number."""
        place = f"{'row' if _is_parquet(self.path) else 'line'} {row}"
        if quantity:
            place += f", column {self.columns[quantity].name!r}"
        return LogError(f"{self.path}, {place}: found {problem}, expected {expected}")

    def read(self) -> Table:
        """Read all rows, or those up to the first damage, which is in the last row.

        Raises:
            LogError: the log and its track would need more memory than there is.
        """
        parts = [Table(self.columns, np.empty(0, np.int64), np.empty((0, len(self.columns))))]
        count = 0
        free = free_memory()
        try:
            for table, share in self._tables():
                parts.append(table)
                count += len(table)
                _require_memory(self.path, count / share, free)
        except DamagedFileError as error:
            cells = np.full((1, len(self.columns)), np.nan)
            parts.append(Table(self.columns, np.array([error.row]), cells, LogError(str(error))))
        return Table.joined(parts)

    def _tables(self) -> Iterator[tuple[Table, float]]:
        """Yield the rows, some thousands at a time, and the share of the file read so far."""
        return _parquet_tables(self) if _is_parquet(self.path) else _csv_tables(self)


def free_memory() -> float:
    """Return how many bytes of memory this program can still use; infinity if this is unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return math.inf
    sizes = dict(line.split(":") for line in lines)
    return 1024.0 * float(sizes["MemAvailable"].split()[0])


def _require_memory(path: Path, rows: float, free: float) -> None:
    needed = rows * _ROW_BYTES
    if needed > free:
        raise LogError(
            f"{path}: found about {rows:.2g} rows, which need {needed / 1e9:.1f} GB of memory, "
            f"expected at most {free / 1e9:.1f} GB, which are free; divide the log"
        )


def open_log(
    path: Path,
    hz_per_mps: float,
    odometry: bool = True,
    associated: bool = True,
    partial: bool = False,
) -> LogFile:
    """Read the header of a log.

    Args:
        path: path of a CSV (plain or gzipped) or Parquet file.
        hz_per_mps, odometry, associated, partial: same as for
            :func:`~mmwave_env.logs.log_columns.columns_of`.

    Raises:
        LogError: the file has another format, or a column is wrong or missing.
        OSError: the file can't be read.
    """
    if not path.name.lower().endswith(SUFFIXES):
        raise LogError(f"{path}: found {path.suffix!r}, expected one of {', '.join(SUFFIXES)}")
    open_regular(path, "a measurement log").close()
    parquet = _is_parquet(path)
    names, delimiter = (list(_parquet_types(path)), ",") if parquet else _csv_names(path)
    try:
        columns = columns_of(names, hz_per_mps, odometry, associated, partial)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error
    log = LogFile(path, columns, len(names), delimiter=delimiter)
    if parquet:
        _require_numbers(log)
    return log


def _is_parquet(path: Path) -> bool:
    return path.suffix.lower() == ".parquet"


def _csv_names(path: Path) -> tuple[list[str], str]:
    """Return the names of columns and the delimiter: a semicolon if the header has no comma."""
    try:
        lines, _ = next(line_blocks(path), ([], 0.0))
    except DamagedFileError as error:
        raise LogError(str(error)) from error
    if not lines:
        raise LogError(f"{path}: found an empty file, expected a measurement log")
    delimiter = "," if "," in lines[0] else ";"
    try:  # str.split would not do, because some programs quote names
        names = [name.strip() for name in next(csv.reader(lines[:1], delimiter=delimiter))]
    except csv.Error:
        names = []
    if len(names) < 2:
        raise LogError(
            f"{path}, line 1: found {lines[0][:60]!r}, expected comma-separated names of columns"
        )
    return names, delimiter


def _csv_tables(log: LogFile) -> Iterator[tuple[Table, float]]:
    first = 1
    for lines, share in line_blocks(log.path):
        header = 1 if first == 1 else 0
        body = lines[header:]
        cells = _parse_quickly(body, log)
        if cells is None:
            table = parse_carefully(log, body, first + header)
        else:
            table = Table(log.columns, np.arange(len(body)) + first + header, cells)
        yield table, share
        if table.damage:
            return
        first += len(lines)


def _parse_quickly(lines: list[str], log: LogFile) -> Array | None:
    """Parse cells (lines, columns); return None if a line needs :func:`parse_carefully`."""
    used = [column.number for column in log.columns.values()]
    if not lines:
        return np.empty((0, len(used)))
    if any(line.count(log.delimiter) != log.width - 1 for line in lines):
        return None
    text = "\n" + "\n".join(lines) + "\n"
    if log.delimiter != ",":
        if "," in text:  # probably decimal commas; parse_carefully refuses them
            return None
        text = text.replace(log.delimiter, ",")
    for empty, filled in ((",,", ",nan,"), (",,", ",nan,"), ("\n,", "\nnan,"), (",\n", ",nan\n")):
        text = text.replace(empty, filled)
    split = text[1:-1].split("\n")
    try:
        cells = np.loadtxt(
            split, delimiter=",", comments=None, ndmin=2, usecols=used, encoding=None
        )
    except ValueError:
        return None
    return cells if len(cells) == len(lines) else None


def parse_carefully(log: LogFile, lines: list[str], first: int) -> Table:
    """Parse cell by cell up to the first damage; skip blank lines, and read blank cells as NaN."""
    cells = []
    rows = []
    damage = None
    for row, line in enumerate(lines, start=first):
        if not line.strip():
            continue
        words = line.split(log.delimiter)
        values = [math.nan] * len(log.columns)
        if len(words) != log.width:
            count = f"{len(words)} cells" if len(words) > 1 else f"one cell, {line[:40]!r}"
            damage = log.error(row, "", count, f"{log.width}, as in the header")
        else:
            for i, (quantity, column) in enumerate(log.columns.items()):
                word = words[column.number].strip()
                values[i] = number(word)
                empty = not word or word.lower().lstrip("+-") == "nan"
                if damage is None and math.isnan(values[i]) and not empty:
                    expected = _ANCHOR if quantity == "anchor" else _NUMBER
                    damage = log.error(row, quantity, quoted(word), expected)
        cells.append(values)
        rows.append(row)
        if damage:
            break
    table = np.array(cells, float).reshape(len(rows), len(log.columns))
    return Table(log.columns, np.array(rows, np.int64), table, damage)


def require_arrow(path: Path) -> tuple[Any, Any]:
    """Return pyarrow and its Parquet module; raise a LogError if they are not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise LogError(f'{path}: Parquet needs pyarrow: pip install "mmwave-loc[data]"') from error
    return pyarrow, pyarrow.parquet


def _open_parquet(path: Path) -> Any:
    pyarrow, parquet = require_arrow(path)
    try:
        # Without buffer_size, a row group of a million rows would be in memory at once.
        return parquet.ParquetFile(
            path, buffer_size=1 << 20, pre_buffer=False, page_checksum_verification=True
        )
    except (OSError, pyarrow.ArrowException) as error:
        raise LogError(f"{path}: found unreadable data ({error}), expected Parquet") from error


def _parquet_types(path: Path) -> dict[str, Any]:
    """Return the names of the columns with their types."""
    try:
        with _open_parquet(path) as file:
            return {field.name: field.type for field in file.schema_arrow}
    except UnicodeDecodeError as error:
        expected = "names of columns in UTF-8"
        raise LogError(f"{path}: found {error.object[:40]!r}, expected {expected}") from error


def _require_numbers(log: LogFile) -> None:
    types = require_arrow(log.path)[0].types
    kinds = _parquet_types(log.path)
    numeric = types.is_floating, types.is_integer, types.is_decimal, types.is_null
    for column in log.columns.values():
        kind = kinds[column.name]
        if not any(is_kind(kind) for is_kind in numeric):
            place = f"{log.path}, column {column.name!r}"
            raise LogError(f"{place}: found type {kind}, expected numbers")


def _parquet_tables(log: LogFile) -> Iterator[tuple[Table, float]]:
    pyarrow, _ = require_arrow(log.path)
    names = [column.name for column in log.columns.values()]
    with _open_parquet(log.path) as file:
        total = max(file.metadata.num_rows, 1)
        done = 0
        try:
            for batch in file.iter_batches(_BATCH_ROWS, columns=names, use_threads=False):
                columns = [batch.column(name).cast(pyarrow.float64(), safe=False) for name in names]
                cells = [column.to_numpy(zero_copy_only=False) for column in columns]
                rows = np.arange(len(batch)) + done + 1
                done += len(batch)
                yield Table(log.columns, rows, np.stack(cells, axis=1)), done / total
        except (OSError, pyarrow.ArrowException) as error:
            problem = f"broken Parquet data ({error})"
            raise DamagedFileError(log.path, done + 1, problem, "a complete file", "row") from error
