"""Trajectories given by a user of this package, from GPS, a traffic simulator or a survey."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mmwave_env.models.envelope import POSITION_M
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask
from mmwave_env.world.mobility import FASTEST_MPS

REACH_M = (1.0, 5000.0)  # distances at which the path loss holds (3GPP TR 38.901, UMi)
STANDING_M, STANDING_S = 0.1, 60.0  # staying so close for so long suggests positions in degrees


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The positions of a user at N times, for episodes with the simulated channel.

    Attributes:
        name: name of the trajectory, for results and messages.
        time_s: (N,) increasing times; at least two, without gaps of more than 15 s.
        position_m: (N, 3) positions in the frame of the scene.
        velocity_mps: (N, 3) velocities; None for the rates of change of the positions, at every
            row the slope of the parabola through the row and its neighbors.
        lines: (N,) lines of the rows in their file, for messages; None if there is no file.

    Raises:
        ValueError: a row is wrong; the message names its line, or its number from 1, and the error.
    """

    name: str
    time_s: Array
    position_m: Array
    velocity_mps: Array | None = None
    lines: Sequence[int] | None = None

    def __post_init__(self) -> None:
        t, p = np.asarray(self.time_s, float), np.asarray(self.position_m, float)
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
        self._require(~POSITION_M.outside(p), p, "x, y, z", POSITION_M.expected)
        self._require_motion(t, p, v)
        object.__setattr__(self, "time_s", t)
        object.__setattr__(self, "position_m", p)
        object.__setattr__(self, "velocity_mps", np.gradient(p, t, axis=0) if v is None else v)

    def _require_motion(self, t: Array, p: Array, v: Array | None) -> None:
        """Refuse motion that is impossible for a user of streets."""
        step = np.diff(t, prepend=t[0] - 1.0)
        moved = np.diff(p, axis=0, prepend=p[:1])
        self._require(step > 0.0, t, "t", "more than in the row before")
        near = f"at most {GAP_S:g} s after the row before; cut the trajectory there, if t is in s"
        self._require(step <= GAP_S, t, "t", near)
        speed = np.linalg.norm(moved, axis=1) / step
        most = f"at most {FASTEST_MPS:g} m/s"
        unit = f"{most}: is t in seconds, and are x, y in meters, not in degrees?"
        self._require(speed <= FASTEST_MPS, speed, "m/s since the row before", unit)
        if v is not None:
            fast = np.linalg.norm(v, axis=1)
            self._require(fast <= FASTEST_MPS, v, "vx, vy, vz", most)
            way, said = np.linalg.norm(moved, axis=1).sum(), fast[1:] @ step[1:]
            if said > 2.0 * way + STANDING_M:
                raise ValueError(
                    f"{self.name}: vx, vy, vz: found a way of {said:.6g} m, expected that of the "
                    f"positions, {way:.6g} m: are they in m/s?"
                )
        if t[-1] - t[0] >= STANDING_S and np.ptp(p, axis=0).max() < STANDING_M:
            warnings.warn(
                f"{self.name}: found all of {t[-1] - t[0]:g} s within {STANDING_M:g} m; x, y are "
                "taken as meters: are they in degrees?",
                stacklevel=4,
            )

    def _require(self, holds: Mask, values: Array, what: str, expected: str) -> None:
        """Refuse the first of the rows (N, ...) in which a condition does not hold."""
        rows = holds.reshape(len(holds), -1).all(axis=1)
        if not rows.all():
            i = int(np.argmin(rows))
            found = ", ".join(f"{value:.6g}" for value in np.ravel(values[i]))
            raise ValueError(
                f"{self.name}, {self._place(i)}: {what}: found {found}, expected {expected}"
            )

    def _place(self, row: int) -> str:
        return f"row {row + 1}" if self.lines is None else f"line {self.lines[row]}"

    def resampled(self, dt: float) -> Array:
        """Return positions and velocities (E, 6) every ``dt`` seconds from the first time on.

        Positions are cubic between rows (Hermite); velocities are the derivatives of positions.
        """
        from scipy.interpolate import CubicHermiteSpline

        count = int((self.time_s[-1] - self.time_s[0]) / dt * (1.0 + 1e-12)) + 1
        at = np.minimum(self.time_s[0] + dt * np.arange(count), self.time_s[-1])
        cubic = CubicHermiteSpline(self.time_s, self.position_m, self.velocity_mps)
        return np.hstack([cubic(at), cubic(at, 1)])

    def way(self, scene: Scene, dt: float) -> Array:
        """Return the way through a scene, (E, 6) as from :meth:`resampled`.

        Raises:
            ValueError: the way is shorter than a step, behind a wall, or out of an anchor's reach.
        """
        way = self.resampled(dt)
        if len(way) < 2:
            raise ValueError(f"{self.name}: found {np.ptp(self.time_s):g} s, expected {dt:g}, dt")
        position = way[:, :3]

        def refuse(epoch: int, expected: str) -> None:
            row = int(np.searchsorted(self.time_s, self.time_s[0] + epoch * dt, "right")) - 1
            found = ", ".join(f"{value:.6g}" for value in position[epoch])
            raise ValueError(
                f"{self.name}, {self._place(row)}: x, y, z: found {found}, expected {expected} of "
                f"scene {scene.name!r}"
            )

        for epoch, wall in scene.behind_walls(position):
            side = wall.side_of(scene.base_station_m)
            refuse(epoch, f"{side}, where the base station is,")
        for anchor in scene.anchors_m:
            distance = np.linalg.norm(position - anchor, axis=1)
            outside = (distance < REACH_M[0]) | (distance > REACH_M[1])
            if outside.any():
                near, far = REACH_M
                reach = f"a place {near:g} to {far:g} m from the anchor at {anchor.tolist()}"
                refuse(int(outside.argmax()), reach)
        return way
