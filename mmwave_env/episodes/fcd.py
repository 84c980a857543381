"""Floating-car data of SUMO: where the vehicles and persons of a traffic simulation were when.

XML, CSV (either also gzipped) and Parquet, as ``sumo --fcd-output FILE`` writes them
(https://sumo.dlr.de/docs/Simulation/Output/FCDOutput.html). All are read in one pass, of which
the trips that are wanted stay.
"""

import csv
import math
from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.parsers import expat

import numpy as np

from mmwave_env.episodes.tables import refuse
from mmwave_env.logs.lines import line_blocks, number
from mmwave_env.logs.log_tables import require_arrow
from mmwave_env.numerics.arrays import Array

SUFFIXES = (".xml", ".xml.gz", ".csv", ".csv.gz", ".parquet")
DIGITS = 2  # of a meter: SUMO rounds so in XML and CSV, and not in Parquet
_NEEDED = ("time", "id", "x", "y")  # and type, which may be missing
_PARTS = ("timestep_", "vehicle_", "person_")  # of the names of columns
_LONGEST_TAG = 1 << 22  # characters; else a forged file would fill the memory
_BATCH_ROWS = 1 << 14


class Trip(NamedTuple):
    """Where a vehicle or a person was: the middle of the front bumper, or the person.

    Attributes:
        name: its id.
        kind: its type, as SUMO calls it.
        time_s: (N,) increasing.
        position_m: (N, 2) in the frame of the traffic simulation, x east, y north.
        rows: (N,) lines of the file, or rows of Parquet, for messages.
    """

    name: str
    kind: str
    time_s: Array
    position_m: Array
    rows: Sequence[int]


class _Row(NamedTuple):
    """A row as it is in the file; what is missing is None."""

    row: int
    time: str | float | None
    id: str | None
    x: str | float | None
    y: str | float | None
    type: str | None


def is_fcd(path: Path) -> bool:
    """Whether a file is floating-car data by its name; a CSV file by its columns, too."""
    name = path.name.lower()
    if name.endswith(".csv") and path.is_file():
        block = next(line_blocks(path), None)
        return block is not None and {"time", "id"} <= set(_columns(block.lines[0])[1])
    return name.endswith(SUFFIXES) and not name.endswith(".csv")


def read_fcd(path: Path, wanted: Callable[[str, str], bool]) -> list[Trip]:
    """The trips of a file, in the order in which they begin.

    Args:
        path: of the file; its name says what it is.
        wanted: whether a trip is, by its id and its type.

    Raises:
        ValueError: naming the file, the row, what was found there and what was expected.
        FileNotFoundError: there is no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: found no such file, expected floating-car data of SUMO")
    readers = {".xml": _xml_rows, ".csv": _csv_rows, ".parquet": _parquet_rows}
    name = path.name.lower().removesuffix(".gz")
    reader = next((read for end, read in readers.items() if name.endswith(end)), None)
    if reader is None:
        refuse(path, "name", repr(path.suffix), f"one that ends in {', '.join(SUFFIXES)}")
    trips: dict[str, tuple[str, array[int], array[float]]] = {}
    for row in reader(path):
        if not row.id:
            refuse(path, _place(path, row.row), "no id", "an id")
        if wanted(row.id, row.type or ""):
            _, rows, places = trips.setdefault(row.id, (row.type or "", array("q"), array("d")))
            t, x, y = (_finite(path, row, key) for key in ("time", "x", "y"))
            if rows and not t > places[-3]:
                expected = f"more than {places[-3]:g}, that of {row.id!r} before"
                refuse(path, f"{_place(path, row.row)}, time", f"{t:g}", expected)
            rows.append(row.row)
            places.extend((t, round(x, DIGITS), round(y, DIGITS)))
    return [_trip(name, *trip) for name, trip in trips.items()]


def _trip(name: str, kind: str, rows: Sequence[int], places: Sequence[float]) -> Trip:
    table = np.array(places).reshape(-1, 3)
    return Trip(name, kind, table[:, 0].copy(), table[:, 1:].copy(), rows)


def _place(path: Path, row: int) -> str:
    return f"{'row' if path.suffix.lower() == '.parquet' else 'line'} {row}"


def _finite(path: Path, row: _Row, key: str) -> float:
    found = getattr(row, key)
    value = number(found) if isinstance(found, str) else found
    if value is None or not math.isfinite(value):
        refuse(path, f"{_place(path, row.row)}, {key} of {row.id!r}", repr(found), "a number")
    return float(value)


# --- XML


def _xml_rows(path: Path) -> Iterator[_Row]:
    parser, rows, time = expat.ParserCreate(), [], None

    def start(tag: str, has: dict[str, str]) -> None:
        nonlocal time
        if tag == "timestep":
            time = has.get("time")
        elif tag in ("vehicle", "person"):
            row = parser.CurrentLineNumber
            rows.append(_Row(row, time, *(has.get(key) for key in ("id", "x", "y", "type"))))

    def doctype(*_: object) -> None:
        refuse(path, _place(path, parser.CurrentLineNumber), "a document type",
               "none: SUMO writes none, and entities may be anything")  # fmt: skip

    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, doctype
    read = 0
    try:
        for block in line_blocks(path):
            text = "\n".join([*block.lines, ""]).encode()
            parser.Parse(text)
            read += len(text)
            if read - parser.CurrentByteIndex > _LONGEST_TAG:
                what = f"a tag of more than {_LONGEST_TAG} characters"
                refuse(path, _place(path, parser.CurrentLineNumber), what, "<vehicle .../>")
            yield from rows
            rows.clear()
        parser.Parse(b"", True)
    except expat.ExpatError as error:
        refuse(path, _place(path, error.lineno), f"broken XML ({error})", "a file that is whole")


# --- CSV


def _columns(header: str) -> tuple[str, list[str]]:
    """What divides columns, and their names without what all have in common."""
    divider = max(";,\t", key=header.count)
    names = [word.strip().strip('"') for word in header.split(divider)]
    for part in _PARTS:
        names = [name.removeprefix(part) for name in names]
    return divider, names


def _csv_rows(path: Path) -> Iterator[_Row]:
    pick: Callable[[list[str]], Iterator[str | None]] | None = None
    divider, width = ";", 0
    for block in line_blocks(path):
        lines, first = block.lines, block.first
        if pick is None:
            divider, names = _columns(lines[0])
            pick, width = _picker(path, names), len(names)
            lines, first = lines[1:], first + 1
        for row, line in enumerate(lines, first):
            if not line:
                continue
            try:
                cells = next(csv.reader([line], delimiter=divider))
            except csv.Error as error:
                refuse(path, _place(path, row), repr(line[:60]), f"CSV ({error})")
            if len(cells) != width:
                refuse(path, _place(path, row), f"{len(cells)} values", f"{width}")
            yield _Row(row, *pick(cells))


def _picker(path: Path, names: list[str]) -> Callable[[Any], Iterator[Any]]:
    """What takes from a row with such columns those that count, in their order."""
    missing = [key for key in _NEEDED if key not in names]
    if missing:
        refuse(path, "header", repr(names), f"columns for {', '.join(missing)}, too")
    places = [names.index(key) if key in names else None for key in _Row._fields[1:]]
    return lambda cells: (None if at is None else cells[at] for at in places)


# --- Parquet


def _parquet_rows(path: Path) -> Iterator[_Row]:
    arrow, parquet = require_arrow(path)
    try:
        with parquet.ParquetFile(path, buffer_size=1 << 20, pre_buffer=False) as file:
            names = file.schema_arrow.names
            used = list(_picker(path, _columns(";".join(names))[1])(names))
            row = 0
            for batch in file.iter_batches(
                _BATCH_ROWS, columns=[name for name in used if name], use_threads=False
            ):
                nothing = [None] * len(batch)
                columns = [batch.column(name).to_pylist() if name else nothing for name in used]
                for cells in zip(*columns, strict=True):
                    row += 1
                    yield _Row(row, *cells)
    except (OSError, arrow.ArrowException) as error:
        raise ValueError(f"{path}: found no readable Parquet ({error}), expected it") from error
