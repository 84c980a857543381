"""Trajectories of users, and *ways*: trajectories in a scene, from which episodes are drawn.

This module also interprets the argument ``scenario=``, which selects kinds of users or ways.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, NoReturn

import numpy as np

from mmwave_env.io.files import AnyPath
from mmwave_env.models.envelope import POSITION_M
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index, Mask
from mmwave_env.world.mobility import FASTEST_MPS, Mobility, mobilities_of

REACH_M = (1.0, 5000.0)  # range of distances where the path loss is valid (TR 38.901, UMi)
# staying within 0.1 m for 60 s is suspect
STANDING_M = 0.1
STANDING_S = 60.0


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The positions of a user at N times, from GPS, a traffic simulator or a survey.

    Attributes:
        name: name of the trajectory, for results and messages.
        time_s: (N,) increasing times; at least two, without gaps of more than 15 s.
        position_m: (N, 3) positions in the frame of the scene.
        velocity_mps: (N, 3) velocities. If None, the velocity of a row is the slope of the parabola
            through its position and the positions before and after it; in the first and last row,
            the slope of the line to the only neighbor.
        lines: (N,) line numbers of the rows in their file, for messages; None without a file.

    Raises:
        ValueError: a row is wrong; the message names the error and the line or row, counted from 1.
    """

    name: str
    time_s: Array
    position_m: Array
    velocity_mps: Array | None = None
    lines: Sequence[int] | None = None

    def __post_init__(self) -> None:
        t = np.asarray(self.time_s, float)
        p = np.asarray(self.position_m, float)
        v = None if self.velocity_mps is None else np.asarray(self.velocity_mps, float)
        for name, values in (("position_m", p), ("velocity_mps", v)):
            if values is not None and (t.ndim != 1 or values.shape != (len(t), 3)):
                raise ValueError(
                    f"{name} of {self.name}: found shape {values.shape}, expected (N, 3), with as "
                    f"many rows as time_s, which has shape {t.shape}"
                )
        if len(t) < 2:
            raise ValueError(f"{self.name}: found {len(t)} rows, expected at least 2")
        for name, values in (("t", t), ("x, y, z", p), ("vx, vy, vz", v)):
            if values is not None:
                self._require(np.isfinite(values), values, name, "finite numbers")
        self._require(POSITION_M.holds(p), p, "x, y, z", POSITION_M.expected)
        self._require_motion(t, p, v)
        object.__setattr__(self, "time_s", t)
        object.__setattr__(self, "position_m", p)
        object.__setattr__(self, "velocity_mps", np.gradient(p, t, axis=0) if v is None else v)

    def _require_motion(self, t: Array, p: Array, v: Array | None) -> None:
        """Refuse motion that no user in streets can make; warn of a user who hardly moves."""
        step = np.diff(t, prepend=t[0] - 1.0)
        moved = np.linalg.norm(np.diff(p, axis=0, prepend=p[:1]), axis=1)
        self._require(step > 0.0, t, "t", "more than in the row before")
        near = (
            f"at most {GAP_S:g} s after the row before; if t is in s, add rows in between, or "
            "split the trajectory there"
        )
        self._require(step <= GAP_S, t, "t", near)
        speed = moved / step
        most = f"at most {FASTEST_MPS:g} m/s"
        unit = f"{most}: is t in seconds, and are x, y in meters, not in degrees?"
        self._require(speed <= FASTEST_MPS, speed, "speed since the row before", unit)
        if v is not None:
            fast = np.linalg.norm(v, axis=1)
            self._require(fast <= FASTEST_MPS, v, "vx, vy, vz", most)
            way = moved.sum()
            integral = fast[1:] @ step[1:]
            if integral > 2.0 * way + STANDING_M:
                raise ValueError(
                    f"{self.name}: vx, vy, vz: found a path of {integral:.6g} m, expected "
                    f"about {way:.6g} m, the length of the path in x, y, z: are the speeds in m/s?"
                )
        still = t[-1] - t[0] >= STANDING_S and np.ptp(p, axis=0).max() < STANDING_M
        if still and np.abs(p[:, :2]).max() <= 180.0:  # no degrees are larger
            warnings.warn(
                f"{self.name}: found all positions of {t[-1] - t[0]:g} s within {STANDING_M:g} m; "
                "x, y are read as meters: are they in degrees?",
                stacklevel=4,
            )

    def _require(self, holds: Mask, values: Array, part: str, expected: str) -> None:
        """Refuse values (N, ...) unless ``holds`` is True in all rows; name the first wrong row."""
        rows = holds.reshape(len(holds), -1).all(axis=1)
        if not rows.all():
            row = int(np.argmin(rows))
            self._refuse(row, part, values[row], expected)

    def _refuse(self, row: int, part: str, values: Array, expected: str) -> NoReturn:
        place = f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"
        shown = ", ".join(f"{value:.6g}" for value in np.ravel(values))
        raise ValueError(f"{self.name}, {place}: {part}: found {shown}, expected {expected}")

    def resampled(self, dt: float) -> Array:
        """Return positions and velocities (E, 6) every ``dt`` seconds from the first time on.

        Positions are interpolated by cubic Hermite splines; velocities are their derivatives.
        """
        from scipy.interpolate import CubicHermiteSpline

        count = int((self.time_s[-1] - self.time_s[0]) / dt * (1.0 + 1e-12)) + 1
        at = np.minimum(self.time_s[0] + dt * np.arange(count), self.time_s[-1])
        cubic = CubicHermiteSpline(self.time_s, self.position_m, self.velocity_mps)
        return np.hstack([cubic(at), cubic(at, 1)])

    def way(self, scene: Scene, dt: float) -> Array:
        """Return positions and velocities (E, 6) from :meth:`resampled`, if they fit a scene.

        Raises:
            ValueError: the way is shorter than ``dt``, behind a wall, or outside :data:`REACH_M`.
        """
        way = self.resampled(dt)
        if len(way) < 2:
            raise ValueError(
                f"{self.name}: found {np.ptp(self.time_s):g} s, expected at least {dt:g} s (dt)"
            )
        position = way[:, :3]

        def refuse(epoch: int, expected: str) -> None:
            row = int(np.searchsorted(self.time_s, self.time_s[0] + epoch * dt, "right")) - 1
            self._refuse(row, "x, y, z", position[epoch], f"{expected} in scene {scene.name!r}")

        if (epoch := scene.first_behind(position)) is not None:
            refuse(epoch, "a position on the base station's side of every wall")
        for anchor in scene.anchors_m:
            distance = np.linalg.norm(position - anchor, axis=1)
            outside = (distance < REACH_M[0]) | (distance > REACH_M[1])
            if outside.any():
                reach = f"{REACH_M[0]:g} to {REACH_M[1]:g} m from the anchor at {anchor.tolist()}"
                refuse(int(outside.argmax()), f"a position {reach}")
        return way


@dataclass(frozen=True, eq=False)
class Ways:
    """A collection of one or more ways (trajectories), from which each episode draws one."""

    name: str
    trajectories: Sequence[Trajectory]

    def placed(self, scene: Scene, dt: float, epochs: int) -> "PlacedWays":
        """Place the ways in a scene, for episodes of at most ``epochs`` epochs, ``dt`` s apart.

        Ways shorter than an episode are left out, with a warning; if all ways are shorter,
        episodes are as long as the longest way. Ways must be in the frame of the scene.

        Raises:
            ValueError: a way does not fit the scene, see :meth:`Trajectory.way`.
        """
        tables = [trajectory.way(scene, dt) for trajectory in self.trajectories]
        epochs = min(epochs, max(map(len, tables)))
        kept = [i for i, table in enumerate(tables) if len(table) >= epochs]
        if len(kept) < len(tables):
            warnings.warn(
                f"{self.name}: found {len(tables) - len(kept)} of {len(tables)} ways shorter than "
                f"an episode ({dt * (epochs - 1):g} s); they are left out (a smaller episode_steps "
                "includes them)",
                stacklevel=2,
            )
        names = [self.trajectories[i].name for i in kept]
        return PlacedWays(names, [tables[i] for i in kept], epochs)


class PlacedWays(NamedTuple):
    """A set of K ways through a scene; an episode is a window of one of them."""

    names: Sequence[str]
    tables: Sequence[Array]  # K arrays (E, 6), E >= epochs: positions (m) and velocities (m/s)
    epochs: int  # length of an episode

    def draw(self, choice: Array) -> tuple[Index, Array]:
        """Draw a way for each of n episodes; return its index (n,) and the truth (n, epochs, 6).

        The numbers ``choice`` (n,), uniform in [0, 1), select way and window: all ways are equally
        likely, and so are all windows of one way.
        """
        scaled = choice * len(self.tables)
        numbers = scaled.astype(np.int64)
        windows = np.array([len(table) for table in self.tables]) - self.epochs + 1
        starts = ((scaled - numbers) * windows[numbers]).astype(np.int64)
        pairs = zip(numbers.tolist(), starts.tolist(), strict=True)
        truth = [self.tables[way][start : start + self.epochs] for way, start in pairs]
        return numbers, np.array(truth).reshape(len(choice), self.epochs, 6)


Scenario = AnyPath | Mobility | Trajectory | Ways
Users = tuple[Mobility, ...] | Ways


def users_of(scenario: Scenario) -> Users:
    """Return the kinds of users, or the ways, that a ``scenario=`` argument stands for.

    Raises:
        ValueError, FileNotFoundError: as for :func:`~mmwave_env.world.mobility.mobilities_of`.
    """
    if isinstance(scenario, Ways):
        return scenario
    if isinstance(scenario, Trajectory):
        return Ways(scenario.name, (scenario,))
    if isinstance(scenario, Mobility):
        return (scenario,)
    return mobilities_of(scenario)
