"""Reader of CSV files with trajectories ("ways") of users."""

import csv
import math
import os
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import numpy as np

from mmwave_env.io.files import AnyPath, read_text
from mmwave_env.io.lookup import is_name, quoted
from mmwave_env.io.records import Printable
from mmwave_env.logs.lines import number
from mmwave_env.world.trajectory import Scenario, Trajectory, Ways

COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz")  # a file has all or none of the last three
ID = "id"


def read_ways(path: AnyPath) -> Ways:
    """Read trajectories from a CSV file with columns t, x, y, z; vx, vy, vz and id are optional.

    Units are s, m and m/s, in the frame of the scene. Rows with the same id belong to one user and
    are in order of time; without a column id, all rows are one user's. Other columns are ignored.

    Raises:
        ValueError: the file is invalid; the message names the file, the row and the error.
        FileNotFoundError: the file does not exist.
    """
    name = os.fspath(path)
    users: dict[str, list[tuple[int, list[float]]]] = {}
    for line, user, numbers in _rows(Path(path)):
        users.setdefault(user, []).append((line, numbers))
    if not users:
        raise ValueError(f"{name}: found 0 rows, expected at least 2")
    trajectories = []
    for user, rows in users.items():
        lines, values = zip(*rows, strict=True)
        table = np.array(values)
        velocity = table[:, 4:] if table.shape[1] > 4 else None
        title = f"{user} of {name}" if user else name
        trajectories.append(Trajectory(title, table[:, 0], table[:, 1:4], velocity, lines))
    return Ways(name, trajectories)


def read_trajectory(path: AnyPath) -> Trajectory:
    """Read the only trajectory in a CSV file, as :func:`read_ways` does; refuse several."""
    ways = read_ways(path).trajectories
    if len(ways) > 1:
        raise ValueError(f"{Path(path)}: column {ID}: found {len(ways)} users, expected one")
    return ways[0]


def _rows(file: Path) -> Iterator[tuple[int, str, list[float]]]:
    """Yield the line number, the id ("" without that column) and the values of every row."""
    reader = csv.DictReader(StringIO(read_text(file, "CSV"), newline=""), skipinitialspace=True)
    try:
        header = reader.fieldnames or ()
        names = COLUMNS if set(COLUMNS[4:]) & set(header) else COLUMNS[:4]
        if not set(names) <= set(header):
            titles = quoted(",".join(header))
            expected = ",".join(names)
            raise ValueError(f"{file}: header: found {titles}, expected the columns {expected}")
        for row in reader:
            line = f"{file}: line {reader.line_num}"
            if None in row or None in row.values():
                raise ValueError(
                    f"{line}: found a wrong number of values, expected {len(header)}, as in line 1"
                )
            user = row.get(ID, "")
            if ID in row and not is_name(user):
                raise ValueError(
                    f"{line}, column {ID}: found {quoted(user)}, expected {Printable.expected}"
                )
            numbers = [number(row[name]) for name in names]
            for name, value in zip(names, numbers, strict=True):
                if not math.isfinite(value):
                    cell = quoted(row[name])
                    raise ValueError(
                        f"{line}, column {name}: found {cell}, expected a finite number"
                    )
            yield reader.line_num, user, numbers
    except csv.Error as error:
        raise ValueError(f"{file}: found text that is not CSV ({error}), expected CSV") from error


def scenario_from(scenario: Scenario) -> Scenario:
    """Return a ``scenario=`` argument; if it names a CSV file, return the file's trajectories."""
    is_file = str(scenario).lower().endswith(".csv")
    return read_ways(scenario) if is_file else scenario  # type: ignore[arg-type]
