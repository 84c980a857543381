"""Ways that users went: read from a CSV file, placed in a scene, and drawn from by episodes.

And what a ``scenario=`` argument means: kinds of users, or such ways.
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

from mmwave_env.files import read_text
from mmwave_env.lookup import is_name, quoted
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.records import Printable
from mmwave_env.world.checks import refuse_in
from mmwave_env.world.mobility import Mobility, mobilities_of
from mmwave_env.world.trajectory import Trajectory

COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz")  # the last three all together or not at all
ID = "id"


@dataclass(frozen=True, eq=False)
class Ways:
    """Ways of one user or of several, of which each episode draws one.

    Attributes:
        name: for results and messages.
        trajectories: (K,) at least one.
    """

    name: str
    trajectories: Sequence[Trajectory]

    def placed(self, scene: Scene, dt: float, epochs: int) -> "PlacedWays":
        """The ways in a scene, for episodes of at most ``epochs`` epochs.

        Ways shorter than an episode are left out; where all of them are, episodes are as long as
        the longest. A warning tells of ways left out.

        Args:
            scene: street in whose frame the positions are.
            dt: s between epochs.
            epochs: longest episode.

        Raises:
            ValueError: as :meth:`Trajectory.way`.
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
        names: (K,) of the ways.
        tables: K arrays (E, 6), E >= ``epochs``: positions (m) and velocities (m/s) at epochs.
        epochs: length of an episode.
    """

    names: Sequence[str]
    tables: Sequence[Array]
    epochs: int

    @cached_property
    def _windows(self) -> Index:
        """Number of windows (K,) in each way."""
        return np.array([len(table) for table in self.tables]) - self.epochs + 1

    def draw(self, choice: Array) -> tuple[Index, Array]:
        """Numbers of the ways (n,) of episodes, and the truth (n, epochs, 6) in them.

        All ways are equally likely, and all windows of one way.

        Args:
            choice: (n,) uniform in [0, 1).
        """
        scaled = choice * len(self.tables)
        which = scaled.astype(np.int64)
        starts = ((scaled - which) * self._windows[which]).astype(np.int64)
        pairs = zip(which.tolist(), starts.tolist(), strict=True)
        truth = [self.tables[way][start : start + self.epochs] for way, start in pairs]
        return which, np.array(truth).reshape(len(choice), self.epochs, 6)


def read_ways(path: str | os.PathLike[str]) -> Ways:
    """The ways of a CSV file with the columns t, x, y, z, perhaps vx, vy, vz, and perhaps id.

    Units are s, m and m/s, in the frame of the scene. Rows with the same id are one user's, in the
    order of time; without that column all rows are. Other columns are ignored.

    Raises:
        ValueError: naming the file, the row and what is wrong in it.
        FileNotFoundError: there is no such file.
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
    """The only way of a CSV file, as :func:`read_ways` reads it.

    Raises:
        ValueError, FileNotFoundError: as :func:`read_ways`; or there are several ways.
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
    """Line, id ("" without that column) and numbers of every row."""
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
    """Kinds of users that are drawn, or given ways.

    Raises:
        ValueError: unknown scenario; the message lists the valid ones. Or a file that holds
            something else than it should.
        FileNotFoundError: there is no such file.
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
