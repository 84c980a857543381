"""Measurement logs as tables of numbers, read from CSV or Parquet.

This module checks only the names of the columns, the number of cells in a row, and that cells are
numbers; ``log_checks.py`` checks the numbers.
"""

import csv
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mmwave_env.io.files import UNEXPECTED, open_regular
from mmwave_env.io.lookup import quoted, require_extra
from mmwave_env.logs.lines import number, read_lines, require_memory
from mmwave_env.logs.log_columns import (
    BODY,
    QUANTITY_OF,
    STATION,
    ByQuantity,
    Unit,
    columns_of,
    require_clock_and_noise,
)
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import seen_from_image
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index, Mask

AnyArrays = TypeVar("AnyArrays", bound="Arrays")

SUFFIXES = (".csv", ".csv.gz", ".parquet")
_ROW_BYTES = 2000  # memory for a row of a Parquet file, and for its part in the track
_UNNAMED = re.compile(r"^(Unnamed: [\d.]+|index|level_0)$")  # pandas' names for its index
_NUMBER = "a number, or nothing if it was not measured"
_EXPECTED = {
    "time": "a number, or a date and time such as 2026-11-20T09:15:00.5Z",
    "anchor": "the number of an anchor in the scene (1: the base station)",
}


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

    def part(self: AnyArrays, rows: slice | Mask | Index) -> AnyArrays:
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
class LogFile:
    """A log of which only the header was read."""

    path: Path  # path of the file
    columns: ByQuantity  # the columns that are used, by quantity
    names: Sequence[str]  # names of all columns in the file; "" if a column has none
    delimiter: str  # character between the cells of a CSV file
    scene: Scene  # scene whose anchors were measured
    layout: Layout  # layout of an epoch
    snr_db: float | None  # SNR to assume for links without an SNR
    associated: bool  # whether rows belong to anchors; if False, they are paths

    @cached_property
    def numbers(self) -> list[int]:
        """Return the indices of the columns that are used."""
        return [column.number for column in self.columns.values()]

    def quick_numbers(self, words: Sequence[str]) -> list[float] | None:
        """Return the numbers of a line, NaN for empty cells; None if it needs a closer look."""
        line = "".join(words)
        if len(words) != len(self.names) or "_" in line or not line.isascii():
            return None
        try:
            numbers = [float(words[i]) if words[i] else math.nan for i in self.numbers]
        except ValueError:
            return None
        return numbers if words[0] else None

    def place(self, row: int) -> str:
        """Return the place of a row; in a CSV file, the row number is the line number."""
        return f"{'row' if _is_parquet(self.path) else 'line'} {row}"

    def error(self, row: int, quantity: str, problem: str, expected: str) -> LogError:
        """Return an error that names a cell, or a row if ``quantity`` is ""."""
        place = self.place(row)
        if quantity:
            place += f", column {self.columns[quantity].name!r}"
        return LogError(f"{self.path}, {place}: found {problem}, expected {expected}")


@dataclass(frozen=True, eq=False)
class Table(Arrays):
    """Rows of a log: all rows of a file, or those up to the first damage."""

    file: LogFile
    rows: Index  # (n,) row numbers in the file, for messages
    cells: Array  # (n, columns) as in the file, NaN where empty
    # damage in the last row, which ends the log; cells of that row that can't be read are NaN
    damage: LogError | None = None
    # (n,) number of each row's epoch, if it is known; otherwise rows of an epoch have one time
    epoch_of_row: Index | None = None

    @property
    def columns(self) -> ByQuantity:
        """Return the columns that are used, by quantity."""
        return self.file.columns

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
        """Return the index (epochs,) of every epoch's first row."""
        # Compare times in the file's unit: different times may become equal in seconds.
        of_epoch = self.raw("time") if self.epoch_of_row is None else self.epoch_of_row
        return np.flatnonzero(np.append(True, np.diff(of_epoch) != 0)[: len(self)])

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

    def links(self, anchor: Index | int) -> Array:
        """Return (n, 4) ranges (m) and angles (rad), as each row's anchor would have measured them.

        Anchors are counted from 0. The scene's ``range_offset_m`` and ``bearing_deg`` are
        subtracted; but a departure relative to the user's body has no bearing. Angles are in the
        map's frame. In a log with a column :data:`STATION`, all angles of arrival were measured at
        the base station. If a path belongs to a mirror image of the base station, its angles at the
        image are different.
        """
        scene = self.file.scene
        bearing = math.radians(scene.bearing_deg)
        departure = self["aod_azimuth"] - bearing
        if BODY in self.columns:  # departures are NaN in epochs without a heading
            departure = self[BODY] + self.first(self["heading"])[self.epoch]
        elevation = self["aoa_elevation"]
        arrival = self["aoa_azimuth"] - bearing
        if STATION in self.columns:
            images = list(scene.anchors_m[anchor].T)
            station = self[STATION] - bearing
            arrival, elevation = seen_from_image(station, elevation, scene.anchors_m[0], images)
        distance = self["toa"] - scene.offsets_m[anchor]
        return np.column_stack([distance, arrival, elevation, departure])


def log_file(
    path: Path,
    names: Sequence[str],
    delimiter: str,
    scene: Scene,
    snr_db: float | None = None,
    clock: str = "synchronized",
    odometry: bool = True,
    associated: bool = True,
) -> LogFile:
    """Return the description of a log with these columns.

    :func:`~mmwave_env.logs.log.read_log` describes the other arguments. If ``associated`` is False,
    rows are paths, and a column of anchors is ignored.

    Raises:
        LogError: a column is wrong or missing, a measurement has neither a standard deviation nor
            an SNR, or no range contains the bias of the clock, as round-trip times do not.
    """
    if snr_db is not None and not math.isfinite(snr_db):
        raise LogError(f"snr: found {snr_db} dB, expected a finite number")
    try:
        columns = columns_of(names, scene.hz_per_mps, odometry, associated)
        require_clock_and_noise(columns, clock, snr_db is not None)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from error
    layout = Layout(len(scene.anchors_m), "speed" in columns, True, clock)
    return LogFile(path, columns, names, delimiter, scene, layout, snr_db, associated)


def read_table(path: Path, scene: Scene, **options: Any) -> Table:
    """Read the rows of a CSV (plain or gzipped) or Parquet file, up to the first damage, if any.

    The ``options`` are those of :func:`log_file`.

    Raises:
        LogError: the file has another format, or a column is wrong or missing.
        MissingExtraError: Parquet needs pyarrow, which is not installed.
        OSError: the file can't be read, or needs more memory than there is.
    """
    if not path.name.lower().endswith(SUFFIXES):
        raise LogError(f"{path}: found {path.suffix!r}, expected one of {', '.join(SUFFIXES)}")
    if _is_parquet(path):
        return _read_parquet(path, scene, **options)
    lines, problem = read_lines(path)
    if not lines:
        raise LogError(f"{path}: found {problem or 'an empty file'}, expected a measurement log")
    names, delimiter = header_of(lines[0], f"{path}, line 1")
    file = log_file(path, names, delimiter, scene, **options)
    return parse(file, (words_of(line, delimiter) for line in lines[1:]), 2, problem)


def _is_parquet(path: Path) -> bool:
    return path.suffix.lower() == ".parquet"


def header_of(line: str, place: str) -> tuple[list[str], str]:
    """Return the names of columns and the delimiter: a semicolon if the header has no comma.

    The name of a column without one is "", also if pandas named it.

    Raises:
        LogError: the line is no header; the message begins with ``place``.
    """
    delimiter = "," if "," in line else ";"
    names = [_UNNAMED.sub("", name.strip()) for name in words_of(line, delimiter)]
    if len(names) < 2 or names[0].lstrip("-")[:1].isdigit():
        raise LogError(f"{place}: found {line[:60]!r}, expected a header with names of columns")
    return names, delimiter


def words_of(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without the quotes of RFC 4180."""
    if '"' in line:
        try:
            return next(csv.reader([line], delimiter=delimiter, strict=True))
        except csv.Error:
            pass  # a cell keeps its quote, so that messages can show it
    return line.split(delimiter)


def parse(file: LogFile, lines: Iterable[list[str]], first: int, problem: str = "") -> Table:
    """Parse lines up to the first damage; skip lines without content, and read blank cells as NaN.

    ``first`` is the number of the first line, and ``problem`` what is damaged after the last line.
    Lines are lists of cells.
    """
    cells = array("d")
    rows = array("q")
    damage = None
    row = first - 1
    for row, words in enumerate(lines, start=first):
        values = file.quick_numbers(words)
        if values is None:
            values, damage = _careful(file, row, words)
        if values:
            cells.extend(values)
            rows.append(row)
        if damage:
            break
    if problem and not damage:
        damage = file.error(row + 1, "", problem, "a complete file")
        cells.extend([math.nan] * len(file.columns))
        rows.append(row + 1)
    table = np.array(cells).reshape(len(rows), len(file.columns))
    return Table(file, np.array(rows), table, damage)


def _careful(file: LogFile, row: int, words: list[str]) -> tuple[list[float], LogError | None]:
    """Return the numbers of a line, none if it has no content, and its first damage, if any."""
    width = len(file.names)
    damage = None
    values = []
    if not any(map(str.strip, words)):
        return [], None
    # Some programs write more delimiters than cells.
    if len(words) < width or "".join(words[width:]).strip():
        count = f"{len(words)} cells" if len(words) > 1 else f"one cell, {words[0][:40]!r}"
        damage = file.error(row, "", count, f"{width}, as in the header")
        return [math.nan] * len(file.columns), damage
    for quantity, column in file.columns.items():
        word = words[column.number]
        value = number(word)
        if math.isnan(value) and not _says_nothing(word):
            value = _other_number(file, quantity, word)
            if math.isnan(value) and not damage:
                expected = _EXPECTED.get(quantity, _NUMBER)
                damage = file.error(row, quantity, quoted(word.strip()), expected)
        values.append(value)
    return values, damage


def _other_number(file: LogFile, quantity: str, word: str) -> float:
    """Parse a decimal comma (if semicolons divide cells), or a date and time (ISO 8601); or NaN.

    A date and time becomes the time since 1970. It is UTC if it states no offset.
    """
    if quantity == "time":
        with suppress(ValueError):
            moment = datetime.fromisoformat(word.strip())
            seconds = moment.replace(tzinfo=moment.tzinfo or UTC).timestamp()
            return seconds * file.columns["time"].unit.divide
    return number(word.replace(",", ".")) if file.delimiter == ";" else math.nan


def _says_nothing(word: str) -> bool:
    """Tell whether a cell says that nothing was measured: it is blank, "nan", "NA" or "null"."""
    return word.strip().lower().lstrip("+-") in ("", "nan", "na", "null", "none")


@contextmanager
def _refusing_damage(path: Path) -> Iterator[None]:
    """Refuse a Parquet file that pyarrow can't read."""
    try:
        yield
    except (OSError, RuntimeError, *UNEXPECTED) as error:
        raise LogError(
            f"{path}: found broken data ({error}), expected a complete Parquet file"
        ) from error


def _read_parquet(path: Path, scene: Scene, **options: Any) -> Table:
    require_extra("pyarrow", "data", f"{path}: Parquet")
    import pyarrow
    from pyarrow import parquet

    open_regular(path, "a measurement log").close()
    with _refusing_damage(path):
        source = parquet.ParquetFile(path, page_checksum_verification=True)
        index = (source.schema_arrow.pandas_metadata or {}).get("index_columns", [])
        names = [
            "" if name in index and name not in QUANTITY_OF else _UNNAMED.sub("", name)
            for name in source.schema_arrow.names
        ]
    file = log_file(path, names, "", scene, **options)
    require_memory(path, _ROW_BYTES * source.metadata.num_rows)
    with _refusing_damage(path), source:
        content = source.read([column.name for column in file.columns.values()])
    types = pyarrow.types
    numeric = (types.is_floating, types.is_integer, types.is_decimal, types.is_null)
    cells = np.empty((len(content), len(file.columns)))
    for i, (quantity, column) in enumerate(file.columns.items()):
        values = content[column.name]
        kind = values.type
        if quantity == "time" and types.is_timestamp(kind):
            values = values.cast(pyarrow.timestamp("us"), safe=False).cast("int64")
            file.columns["time"] = column._replace(unit=Unit(divide=1e6))
        elif not any(is_kind(kind) for is_kind in numeric):
            raise LogError(f"{path}, column {column.name!r}: found type {kind}, expected numbers")
        cells[:, i] = values.cast("float64", safe=False)
    return Table(file, np.arange(len(cells)) + 1, cells)
