"""Ways of users, which are read from a CSV file, placed in a scene and drawn by episodes.

This module also interprets a ``scenario=`` argument: kinds of users, or such ways.
"""

import csv
import math
import os
import warnings
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path

import numpy as np

from mmwave_env.io.files import read_text
from mmwave_env.io.lookup import is_name, quoted
from mmwave_env.io.records import Printable
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.world.checks import refuse_in
from mmwave_env.world.mobility import Mobility, mobilities_of
from mmwave_env.world.trajectory import Trajectory

COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz")  # either all of the last three or none
ID = "id"


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways of one or several users, of which each episode draws one.

    Attributes:
        name: name of the ways, for results and messages.
        trajectories: (K,) trajectories, at least one.
    """

    name: str
    trajectories: Sequence[Trajectory]

    def placed(self, scene: Scene, dt: float, epochs: int) -> "PlacedWays":
        """Place the ways in a scene, for episodes of at most ``epochs`` epochs.

        Ways shorter than an episode are left out, with a warning; if all ways are shorter,
        episodes are as long as the longest way.

        Args:
            scene: the scene in whose frame the positions are.
            dt: seconds between epochs.
            epochs: greatest length of an episode.

        Raises:
            ValueError: as for :meth:`Trajectory.way`.
        """
        tables = [trajectory.way(scene, dt) for trajectory in self.trajectories]
        epochs = min(epochs, max(map(len, tables)))
        kept = [i for i, table in enumerate(tables) if len(table) >= epochs]
        if len(kept) < len(tables):
            warnings.warn(
                f"{self.name}: found {len(tables) - len(kept)} of {len(tables)} ways shorter than "
                f"{dt * (epochs - 1):g} s, an episode; they are left out (a smaller episode_steps "
                "takes them)",
                stacklevel=2,
            )
        names = [self.trajectories[i].name for i in kept]
        return PlacedWays(names, [tables[i] for i in kept], epochs)


@dataclass(frozen=True, eq=False)
class PlacedWays:
    """K ways through a scene; an episode is a window of one of them.

    Attributes:
        names: (K,) names of the ways.
        tables: K arrays (E, 6), E >= ``epochs``: positions (m) and velocities (m/s) at epochs.
        epochs: length of an episode.
    """

    names: Sequence[str]
    tables: Sequence[Array]
    epochs: int

    @cached_property
    def _windows(self) -> Index:
        """Return the number of windows (K,) in each way."""
        return np.array([len(table) for table in self.tables]) - self.epochs + 1

    def draw(self, choice: Array) -> tuple[Index, Array]:
        """Draw the numbers of the ways (n,) of episodes, and their truth (n, epochs, 6).

        All ways are equally likely, and so are all windows of one way.

        Args:
            choice: (n,) uniform numbers in [0, 1).
        """
        scaled = choice * len(self.tables)
        which = scaled.astype(np.int64)
        starts = ((scaled - which) * self._windows[which]).astype(np.int64)
        pairs = zip(which.tolist(), starts.tolist(), strict=True)
        truth = [self.tables[way][start : start + self.epochs] for way, start in pairs]
        return which, np.array(truth).reshape(len(choice), self.epochs, 6)


def read_ways(path: str | os.PathLike[str]) -> Ways:
    """Read the ways of a CSV file with columns t, x, y, z, perhaps vx, vy, vz, and perhaps id.

    Units are s, m and m/s, in the frame of the scene. Rows with the same id belong to one user, in
    the order of time; without that column all rows do. Other columns are ignored.

    Raises:
        ValueError: the file is wrong; the message names the file, the row and the error.
        FileNotFoundError: the file does not exist.
    """
    name = os.fspath(path)
    users: dict[str, tuple[list[int], array[float]]] = {}
    for line, user, numbers in _rows(Path(path)):
        lines, values = users.setdefault(user, ([], array("d")))
        lines.append(line)
        values.extend(numbers)
    if not users:
        raise ValueError(f"{name}: found 0 rows, expected at least 2")
    return Ways(name, [_way(f"{id} of {name}" if id else name, *way) for id, way in users.items()])


def read_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Read the only way of a CSV file, as :func:`read_ways` does.

    Raises:
        ValueError, FileNotFoundError: as for :func:`read_ways`; or there are several ways.
    """
    ways = read_ways(path).trajectories
    if len(ways) > 1:
        refuse_in(Path(path), f"column {ID}", f"{len(ways)} users", "one")
    return ways[0]


def _way(name: str, lines: list[int], values: Sequence[float]) -> Trajectory:
    table = np.array(values).reshape(len(lines), -1)
    velocity = table[:, 4:] if table.shape[1] > 4 else None
    return Trajectory(name, table[:, 0], table[:, 1:4], velocity, lines)


def _rows(file: Path) -> Iterator[tuple[int, str, list[float]]]:
    """Yield line, id ("" without that column) and numbers of every row."""
    reader = csv.reader(StringIO(read_text(file, "CSV"), newline=""), skipinitialspace=True)
    rows = ((reader.line_num, row) for row in reader if row)
    try:
        _, header = next(rows, (1, []))
        names = COLUMNS if any(name in header for name in COLUMNS[4:]) else COLUMNS[:4]
        if any(name not in header for name in names):
            refuse_in(file, "header", quoted(",".join(header)), f"the columns {','.join(names)}")
        columns = {name: header.index(name) for name in names}
        id_column = header.index(ID) if ID in header else None
        for line, row in rows:
            if len(row) != len(header):
                refuse_in(file, f"line {line}", f"{len(row)} values", f"{len(header)}")
            user = "" if id_column is None else row[id_column]
            if id_column is not None and not is_name(user):
                refuse_in(file, f"line {line}, column {ID}", quoted(user), Printable.expected)
            yield line, user, [_number(file, line, name, row[c]) for name, c in columns.items()]
    except csv.Error as error:
        raise ValueError(f"{file}: found no readable CSV ({error}), expected CSV") from error


def _number(file: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        refuse_in(file, f"line {line}, column {column}", quoted(text), "a finite number")
    return value


Scenario = str | os.PathLike[str] | Mobility | Trajectory | Ways
Users = tuple[Mobility, ...] | Ways


def users_of(scenario: Scenario) -> Users:
    """Return the kinds of users, or the given ways, of a ``scenario=`` argument.

    Raises:
        ValueError: the scenario is unknown, and the message lists the known ones; or the file
            is wrong.
        FileNotFoundError: the file does not exist.
    """
    if isinstance(scenario, Ways):
        return scenario
    if isinstance(scenario, Trajectory):
        return Ways(scenario.name, (scenario,))
    if isinstance(scenario, Mobility):
        return (scenario,)
    if str(scenario).lower().endswith(".csv"):
        return read_ways(scenario)
    return mobilities_of(scenario)
