"""Trips of a traffic simulation, sent through the simulated channel one at a time."""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from mmwave_env.episodes.fcd import DIGITS, Trip, read_fcd
from mmwave_env.episodes.trajectory import STANDING_M, Trajectory
from mmwave_env.episodes.ways import Ways
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.arrays import Array
from mmwave_env.records import Filled, Positive, object_from, read_object, require_fields

FROM_WALLS_M = 1.0  # how far the traffic as a whole stays in front of walls


@dataclass(frozen=True)
class Traffic:
    """Trips of vehicles and persons from a traffic simulation; every seed draws one of them.

    Attributes:
        fcd: file of floating-car data, as SUMO writes it: XML, CSV (also .gz) or Parquet.
        types: of vehicles and persons, as SUMO calls them; in these and in ids, * stands for any
            characters.
        ids: of vehicles and persons.
        min_seconds: how long trips last at least; as long as an episode, or as the longest trip
            where none is as long, if left out.
        shift_m: [x, y] added to all positions; so that the middle of the traffic is that of the
            streets, or as near to it as walls allow, if left out.
        name: for results and messages; that of fcd if left out.
    """

    fcd: str
    types: Filled[str] = ("*",)
    ids: Filled[str] = ("*",)
    min_seconds: Positive | None = None
    shift_m: Annotated[tuple[float, float], "[x, y]"] | None = None
    name: str = ""

    def __post_init__(self) -> None:
        require_fields(self)
        if not self.name:
            object.__setattr__(self, "name", Path(self.fcd).name)

    @cached_property
    def trips(self) -> list[Trip]:
        """Those that are wanted, in any scene.

        Raises:
            ValueError: there is none.
        """
        seen: set[str] = set()

        def wanted(name: str, kind: str) -> bool:
            seen.add(kind)
            return _matches(name, self.ids) and _matches(kind, self.types)

        trips = read_fcd(Path(self.fcd), wanted)
        if not trips:
            known = f"types {', '.join(sorted(seen))}" if seen else "no vehicle and no person"
            raise ValueError(
                f"{self.fcd}: found {known}, expected trips of types {', '.join(self.types)} and "
                f"ids {', '.join(self.ids)}"
            )
        return trips

    def ways(self, scene: Scene, dt: float, epochs: int) -> Ways:
        """The ways of those trips that can be gone in a scene, for episodes of so many epochs.

        Users are at the height of those of the scene's streets. A warning says if some trips can't
        be gone there, and if most of them are too short for such episodes.

        Raises:
            ValueError: there is none; the message says why, or what is wrong in the file.
            FileNotFoundError: there is no such file.
        """
        shift = self._shift(scene)
        shortest_s = max(self.min_seconds or dt, dt) * (1.0 - 1e-12)
        lasting = [trip for trip in self.trips if np.ptp(trip.time_s) >= shortest_s]
        tried = [self._way(trip, shift, scene, dt) for trip in lasting]
        refused = [one for one in tried if isinstance(one, str)]
        gone = [one for one in tried if not isinstance(one, str)]
        longest = max((len(way) for _, way in gone), default=2)
        least = 2 if self.min_seconds else min(epochs, longest)
        kept = [(trajectory, way) for trajectory, way in gone if len(way) >= least]
        counts = {
            f"shorter than {self.min_seconds or dt * (least - 1):g} s": len(self.trips)
            - len(refused)
            - len(kept),
            f"that nobody can go here, the first: {''.join(refused[:1])}": len(refused),
        }
        left_out = [f"{count} {why}" for why, count in counts.items() if count]
        about = (
            f"{len(kept)} of {len(self.trips)} trips, moved by ({shift[0]:g}, {shift[1]:g}) m"
            f"{'; left out: ' * bool(left_out)}{'; '.join(left_out)}"
        )
        if not kept:
            raise ValueError(f"{self.fcd}: found {about}; expected one trip at least")
        few = self.min_seconds is None and 2 * len(kept) < len(self.trips)
        if refused or few:
            hint = "; there are more for shorter episodes (episode_steps)" * few
            warnings.warn(f"{self.fcd}: {about}{hint}", stacklevel=2)
        trajectories, tables = zip(*kept, strict=True)
        begin_s = [float(one.time_s[0]) for one in trajectories]
        return Ways([one.name for one in trajectories], begin_s, tables, dt, epochs, about)

    def _way(
        self, trip: Trip, shift: Array, scene: Scene, dt: float
    ) -> tuple[Trajectory, Array] | str:
        """A trip in a scene, and its way there; or why it can't be gone."""
        try:
            trajectory = self._trajectory(trip, shift, scene.streets.height_m)
            return trajectory, trajectory.way(scene, dt)
        except ValueError as error:
            return str(error)

    def _trajectory(self, trip: Trip, shift: Array, height_m: float) -> Trajectory:
        """A trip in the frame of a scene.

        Raises:
            ValueError: as of a trajectory; or all of it is in one place.
        """
        name = f"{trip.name} of {self.name}"
        if np.ptp(trip.position_m, axis=0).max() < STANDING_M:
            raise ValueError(
                f"{name}: found all of it within {STANDING_M:g} m, expected one who moves, and "
                "meters (--fcd-output.geo writes degrees)"
            )
        place = np.pad(trip.position_m + shift, [(0, 0), (0, 1)], constant_values=height_m)
        return Trajectory(name, trip.time_s, place, lines=trip.rows)

    def _shift(self, scene: Scene) -> Array:
        """What is added to positions (2,)."""
        if self.shift_m is not None:
            return np.array(self.shift_m, float)
        places = np.concatenate([trip.position_m for trip in self.trips])
        low, high = places.min(axis=0), places.max(axis=0)
        streets = np.array([scene.streets.x_m, scene.streets.y_m]).mean(axis=1)
        shift: Array = streets - 0.5 * (low + high)
        corners = np.array([(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])])
        for wall in scene.walls:
            inward = np.sign(wall.signed_distance(scene.base_station_m))
            room = float((inward * wall.signed_distance((corners + shift).T)).min())
            shift += max(0.0, FROM_WALLS_M - room) * inward * np.array(wall.unit_normal)
        return np.round(shift, DIGITS)


def _matches(word: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(word, pattern) for pattern in patterns)


def read_traffic(path: str | os.PathLike[str]) -> Traffic:
    """Traffic from a JSON file: the fields of :class:`Traffic`.

    "fcd" is a file in the folder of this one or below it; "name" is by default that of this file.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    folder = Path(path).parent

    def make(content: dict[str, Any]) -> Traffic:
        traffic = object_from(Traffic, {"name": Path(path).stem} | content)
        fcd = folder / traffic.fcd
        if not fcd.resolve().is_relative_to(folder.resolve()):
            raise ValueError(f"fcd: found {traffic.fcd!r}, expected a file in the folder {folder}")
        return replace(traffic, fcd=os.fspath(fcd))

    return read_object(path, "traffic", make)
