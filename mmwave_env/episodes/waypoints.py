"""Way-points: where a user comes by, how fast, and where it stands; a way made of them.

Legs are straight and corners rounded. With s the length along the legs, the speed v(s) is the
highest that keeps below every leg's own and never changes faster than the legs allow,

    v(s)^2 = min over s' of v_max(s')^2 + 2 |integral from s' to s of a|,

where v_max = 0 at every stop.
"""

import os
from pathlib import Path

import numpy as np

from mmwave_env.episodes.mobility import FASTEST_MPS
from mmwave_env.episodes.tables import TRAJECTORY, columns_of, read_table, refuse
from mmwave_env.episodes.trajectory import Trajectory, read_trajectory
from mmwave_env.lookup import quoted
from mmwave_env.numerics.arrays import Array

WAYPOINT = ("x", "y", "z", "speed_mps", "acceleration_mps2", "wait_s")  # columns
_USUAL = (1.0, 0.0)  # acceleration, m/s^2, and wait, s, of files without the last two
_ROUNDED_M = 2.0  # before and behind a corner the way is the mean of so much of the legs
_SHORTEST_M = 0.5  # of a leg
_STEP_M = 0.1  # between rows of the way
_STANDING_S = 5.0  # between its rows at a stop


def read_way(path: str | os.PathLike[str]) -> Trajectory:
    """A way from a CSV file: a trajectory if it has a column t, else way-points.

    Raises:
        ValueError, FileNotFoundError: as of
            :func:`~mmwave_env.episodes.trajectory.read_trajectory` and :func:`read_waypoints`.
    """
    columns = columns_of(Path(path))
    if TRAJECTORY[0] in columns:
        return read_trajectory(path)
    if WAYPOINT[3] not in columns:
        refuse(
            Path(path), "header", quoted(",".join(columns)),
            f"the columns {','.join(TRAJECTORY[:4])} of a way, or {','.join(WAYPOINT[:4])} of "
            "way-points",
        )  # fmt: skip
    return read_waypoints(path)


def read_waypoints(path: str | os.PathLike[str]) -> Trajectory:
    """The way through way-points of a CSV file, with the columns ``WAYPOINT`` or their first four.

    The leg from a row on has its speed and its limit of acceleration and braking; before that the
    user stands there for ``wait_s``. Who does not wait in the first or the last row is in motion
    there.

    Raises:
        ValueError: naming the file, the line and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    file = Path(path)
    lines, table = read_table(file, WAYPOINT[:4], WAYPOINT[4:])
    if table.shape[1] == 4:
        table = np.hstack([table, np.tile(_USUAL, (len(table), 1))])
    if len(table) < 2:
        refuse(file, "rows", len(table), "at least 2 way-points")
    leg = np.linalg.norm(np.diff(table[:, :3], axis=0), axis=1)
    speed, acceleration, wait = table[:, 3:].T
    for what, values, holds, expected in (
        ("column speed_mps", speed, (speed > 0.0) & (speed <= FASTEST_MPS),
         f"more than 0, at most {FASTEST_MPS:g}"),
        ("column acceleration_mps2", acceleration, acceleration > 0.0, "more than 0"),
        ("column wait_s", wait, wait >= 0.0, "at least 0"),
        ("columns x, y, z", np.append(np.inf, leg), np.append(True, leg >= _SHORTEST_M),
         f"at least {_SHORTEST_M:g} m from the row before"),
    ):  # fmt: skip
        if not holds.all():
            row = int(np.argmin(holds))
            refuse(file, f"line {lines[row]}, {what}", f"{values[row]:g}", expected)
    return way_through(os.fspath(path), table[:, :3], speed, acceleration, wait)


def way_through(
    name: str, position_m: Array, speed_mps: Array, acceleration_mps2: Array, wait_s: Array
) -> Trajectory:
    """The way through way-points (N, 3), N >= 2, with the other columns (N,) of ``WAYPOINT``."""
    leg = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
    corner = np.append(0.0, np.cumsum(leg))
    s = np.union1d(corner, np.arange(0.0, corner[-1], _STEP_M))
    on = np.minimum(np.searchsorted(corner, s, "right") - 1, len(leg) - 1)
    waits = np.zeros_like(s)
    waits[np.searchsorted(s, corner)] = wait_s
    squared = np.where(waits > 0.0, 0.0, speed_mps[on] ** 2)
    gain = np.append(0.0, np.cumsum(2.0 * acceleration_mps2[on[:-1]] * np.diff(s)))
    speeding = np.minimum.accumulate(squared - gain) + gain
    braking = np.minimum.accumulate((squared + gain)[::-1])[::-1] - gain
    v = np.sqrt(np.maximum(np.minimum(speeding, braking), 0.0))
    passed = np.append(0.0, np.cumsum(2.0 * np.diff(s) / (v[1:] + v[:-1])))
    arrival = passed + np.append(0.0, np.cumsum(waits[:-1]))

    rows = 1 + np.ceil(waits / _STANDING_S).astype(int)
    node = np.repeat(np.arange(len(s)), rows)
    nth = np.arange(len(node)) - np.repeat(np.cumsum(rows) - rows, rows)
    time = arrival[node] + waits[node] * nth / np.maximum(rows[node] - 1, 1)
    position, tangent = _rounded(corner, position_m, s)
    return Trajectory(name, time, position[node], v[node, None] * tangent[node])


def _rounded(corner: Array, position_m: Array, s: Array) -> tuple[Array, Array]:
    """Positions (n, 3) at lengths s along the legs, and their derivatives by s."""
    from scipy.interpolate import make_interp_spline

    ends = corner[[0, -1]] + [-_ROUNDED_M, _ROUNDED_M]
    first = position_m[0] - _ROUNDED_M * (position_m[1] - position_m[0]) / corner[1]
    last = position_m[-1] + _ROUNDED_M * (position_m[-1] - position_m[-2]) / (
        corner[-1] - corner[-2]
    )
    legs = make_interp_spline(
        np.hstack([ends[0], corner, ends[1]]), np.vstack([first, position_m, last]), k=1
    )
    area, behind, ahead = legs.antiderivative(), s - _ROUNDED_M, s + _ROUNDED_M
    width = 2.0 * _ROUNDED_M
    return (area(ahead) - area(behind)) / width, (legs(ahead) - legs(behind)) / width
