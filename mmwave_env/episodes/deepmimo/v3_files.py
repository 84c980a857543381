"""The MATLAB files of DeepMIMO v3: the users of one file, and what else is said in them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.deepmimo.array_files import readable
from mmwave_env.episodes.deepmimo.mat_files import Matrix, variables
from mmwave_env.episodes.tables import refuse
from mmwave_env.numerics.arrays import Array

ROWS = ("phase", "ToA", "power", "DoA_phi", "DoA_theta", "DoD_phi", "DoD_theta", "LoS")
_DOPPLER_ROWS = 2  # that may follow
_CHANNELS = ("channels", "channels_VV")  # the second where there are two polarizations
_MOST_PATHS = 1000  # of a user


def read_number(file: Path, name: str, above: float = -np.inf) -> float:
    """A variable that is one number, above another.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it can't be read, or holds something else; the message names it.
    """
    value = _numbers(file, name)
    if value.size != 1 or not above < value.item() < np.inf:
        found = value.item() if value.size == 1 else f"{value.size} values"
        refuse(file, name, found, f"a number above {above:g}" if above > -np.inf else "a number")
    return float(value.item())


def read_station(users: Path, station: str) -> Array:
    """Position (3,) of a base station, m: from a file of its users, or that of all stations.

    Raises:
        FileNotFoundError, ValueError: as of :func:`read_number`.
    """
    if _variable(users, "tx_loc") is not None:
        place = _numbers(users, "tx_loc").ravel()
    else:
        users = users.with_name(f"{station}_BS.mat")
        row = int(station.removeprefix("BS")) - 1
        place = read_locations(users)[row : row + 1].ravel()
    if place.size != 3 or not np.isfinite(place).all():
        refuse(users, "tx_loc, rx_locs", f"{place.tolist()} for {station}", "x, y, z")
    return place


def read_locations(file: Path, users: int | None = None) -> Array:
    """Positions (n, 3) of the users of a file, m.

    Raises:
        FileNotFoundError, ValueError: as of :func:`read_number`, or it has not as many users.
    """
    table = _numbers(file, "rx_locs")
    expected = "users" if users is None else users
    if table.ndim != 2 or table.shape[1] < 3 or len(table) != (users or len(table)):
        refuse(file, "rx_locs", f"shape {table.shape}", f"shape ({expected}, 5)")
    if not np.isfinite(table[:, :3]).all():
        row = int(np.argmin(np.isfinite(table[:, :3]).all(axis=1)))
        refuse(file, f"rx_locs, row {row + 1}", table[row, :3].tolist(), "finite x, y, z")
    return np.ascontiguousarray(table[:, :3])


def read_channels(file: Path, users: NDArray[np.int_]) -> list[Array]:
    """Paths (8, P) of some users of a file, in the rows of ROWS; P differs.

    Raises:
        FileNotFoundError, ValueError: as of :func:`read_number`.
    """
    channels = _variable(file, *_CHANNELS)
    if channels is None:
        refuse(file, "variables", f"no {' or '.join(_CHANNELS)}", "the paths of users")
    paths = []
    for user in users.tolist():
        key = f"{channels.name}{{{user + 1}}}.p"
        with readable(file, key):
            rows = channels.cell(user).field("p").numbers()
        paths.append(_paths(file, key, rows.astype(float)))
    return paths


def _paths(file: Path, key: str, rows: Array) -> Array:
    """The rows of a user that are known by name."""
    if not rows.size:  # of a user whom no path reaches; its shape differs
        return np.empty((len(ROWS), 0))
    counts = (len(ROWS), len(ROWS) + _DOPPLER_ROWS)
    if rows.ndim != 2 or rows.shape[0] not in counts or rows.shape[1] > _MOST_PATHS:
        refuse(file, key, f"shape {rows.shape}",
               f"{counts[0]} or {counts[1]} rows, at most {_MOST_PATHS} paths")  # fmt: skip
    rows = rows[: len(ROWS)]
    if not np.isfinite(rows).all():
        row, path = (int(i) for i in np.argwhere(~np.isfinite(rows))[0])
        refuse(file, f"{key}({row + 1}, {path + 1}), {ROWS[row]}", rows[row, path],
               "a finite number")  # fmt: skip
    return rows


def _numbers(file: Path, name: str) -> Array:
    """A variable of numbers."""
    variable = _variable(file, name)
    if variable is None:
        refuse(file, "variables", f"no {name}", "numbers of that name")
    with readable(file, name):
        return variable.numbers().astype(float)


def _variable(file: Path, *names: str) -> Matrix | None:
    """The first variable that has one of the names."""
    if not file.is_file():
        raise FileNotFoundError(f"{file}: found no such file in the scenario, expected one")
    with readable(file, names[0]):
        return next((found for found in variables(file) if found.name in names), None)
