"""DeepMIMO v3 scenarios, MATLAB files such as the public O1_28 and Dynamic Doppler: to paths.

A scenario is a folder with ``params.mat`` (carrier_freq in Hz, transmit_power in dBm) and, for each
base station b, files ``BS{b}_UE_{first}-{last}.mat`` of some users each, the last not among them; a
dynamic one has them in folders ``scene_0``, ``scene_1``, ... A file holds

    channels     a cell for each user, of a struct whose field p has a column for each path and the
                 rows phase, ToA (s), power (dBm), DoA_phi, DoA_theta, DoD_phi, DoD_theta (degrees,
                 theta from the zenith), LoS (1 or 0) [, Doppler_vel, Doppler_acc]
    rx_locs      a row for each user: x, y, z (m), distance, path loss
    tx_loc       x, y, z; else row b of ``rx_locs`` in ``BS{b}_BS.mat``

It does not say how a path came about: :mod:`~mmwave_env.episodes.deepmimo.reflections` finds out.
Doppler shifts are not read; they follow from velocities, as of version 4. Written after the loaders
that came with the data, and untested on the public files.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.deepmimo.paths import (
    LINE_OF_SIGHT,
    REFLECTION,
    Paths,
    StationPaths,
    propagation,
)
from mmwave_env.episodes.deepmimo.reflections import single_bounces
from mmwave_env.episodes.deepmimo.scenario import Scenario, by_scene
from mmwave_env.episodes.deepmimo.v3_files import (
    ROWS,
    read_channels,
    read_locations,
    read_number,
    read_station,
)
from mmwave_env.episodes.tables import refuse
from mmwave_env.lookup import as_name
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.numerics.arrays import Array

PARAMS = "params.mat"  # by which a folder is known as a scenario
_USERS = re.compile(r"(BS\d+)_UE_(\d+)-(\d+)\.mat")
_SCENE = re.compile(r"scene_(\d+)")
_UNKNOWN = -1.0  # of ``interactions``: nobody says which


@dataclass(frozen=True, kw_only=True)
class V3Scenario(Scenario):
    """A scenario with some users a file, who are counted from 0 through the files that are there.

    Attributes:
        files: of each scene, by station, the files and how many users there are in each.
        transmit_dbm: power that the paths were traced with.
    """

    files: tuple[dict[str, dict[Path, int]], ...]
    transmit_dbm: float

    def grid(self, scene: int = 0) -> Array:
        """Positions (N, 3) of all users in a scene, m; of the files one is in memory at a time."""
        files = self.files[scene][self.stations[0]]
        return np.concatenate([read_locations(file, users) for file, users in files.items()])

    def positions(self, epochs: NDArray[np.int_]) -> Array:
        """Positions (E, 3) of the users of epochs, m."""
        position = np.empty((len(epochs), 3))
        for file, count, at, rows in self._files(epochs, self.stations[0]):
            position[at] = read_locations(file, count)[rows]
        return position

    def paths(self, epochs: NDArray[np.int_], base_station: int | None = None) -> Paths:
        """As of :class:`Scenario`; of the files one is in memory at a time."""
        position = self.positions(epochs)
        return Paths(
            name=as_name(self.folder.resolve().name),
            carrier_hz=self.carrier_hz,
            position_m=position,
            stations=tuple(
                self._station(name, epochs, position) for name in self.chosen(base_station)
            ),
        )

    def _station(self, name: str, epochs: NDArray[np.int_], position_m: Array) -> StationPaths:
        users: list[Array] = [np.empty(0)] * len(epochs)
        sources: list[tuple[Path, int]] = [(self.folder, 0)] * len(epochs)
        for file, _, at, rows in self._files(epochs, name):
            for i, row, paths in zip(at, rows.tolist(), read_channels(file, rows), strict=True):
                users[i], sources[i] = paths, (file, row)
        columns = np.full((len(ROWS), len(users), max(1, *(p.shape[1] for p in users))), np.nan)
        for i, paths in enumerate(users):
            columns[:, i, : paths.shape[1]] = paths
        row = dict(zip(ROWS, columns, strict=True))
        arrival, departure = (
            np.radians(np.stack([row[f"{of}_phi"], row[f"{of}_theta"]], axis=-1))
            for of in ("DoA", "DoD")
        )
        station = read_station(next(iter(self.files[0][name])), name)
        interactions, bounce = _interactions(
            station, position_m, SPEED_OF_LIGHT * row["ToA"], arrival, departure, row["LoS"]
        )
        return StationPaths(
            name=name,
            position_m=station,
            interactions=interactions,
            bounce_m=bounce,
            gain_db=row["power"] - self.transmit_dbm,
            delay_s=row["ToA"],
            arrival=arrival,
            departure=departure,
            source=lambda key, epoch: sources[epoch],
            phase_rad=np.radians(row["phase"]),
        )

    def _files(
        self, epochs: NDArray[np.int_], station: str
    ) -> Iterator[tuple[Path, int, NDArray[np.int_], NDArray[np.int_]]]:
        """Files that hold users of epochs (E, 2): how many, which epochs, the users' rows in it."""
        for scene, _ in by_scene(epochs):
            first = 0
            for file, count in self.files[scene][station].items():
                row = epochs[:, 1] - first
                here = np.flatnonzero((epochs[:, 0] == scene) & (row >= 0) & (row < count))
                if len(here):
                    yield file, count, here, row[here]
                first += count


def _interactions(
    station_m: Array,
    position_m: Array,
    range_m: Array,
    arrival: Array,
    departure: Array,
    los: Array,
) -> tuple[Array, Array]:
    """How paths (E, P) came about, and where they bounced (E, P, 3), as of StationPaths."""
    direct = los == 1.0
    interactions = np.where(direct, LINE_OF_SIGHT, np.where(np.isfinite(los), _UNKNOWN, np.nan))
    if not direct.any():  # which way directions point is not known
        return interactions, np.full((*los.shape, 3), np.nan)
    sight = (position_m - station_m)[:, None]
    bounce = single_bounces(
        station_m, position_m, np.where(direct, np.nan, range_m),
        propagation(arrival, sight, direct), propagation(departure, sight, direct),
    )  # fmt: skip
    return np.where(np.isfinite(bounce).all(axis=-1), REFLECTION, interactions), bounce


def open_v3(folder: Path) -> V3Scenario:
    """What a folder holds.

    Raises:
        FileNotFoundError: a file that must be there is missing.
        ValueError: ``params.mat`` can't be read, or scenes have other stations.
    """
    params = folder / PARAMS
    numbered = {int(m[1]): sub for sub in folder.iterdir() if (m := _SCENE.fullmatch(sub.name))}
    scenes = tuple(numbered[n] for n in sorted(numbered)) or (folder,)
    files = tuple(_files_of(scene) for scene in scenes)
    for scene, found in zip(scenes, files, strict=True):
        if not found or found.keys() != files[0].keys():
            refuse(scene, "BS*_UE_*-*.mat", f"those of {', '.join(found) or 'no base station'}",
                   f"those of {', '.join(files[0]) or 'one at least'}")  # fmt: skip
    stations = tuple(files[0])
    return V3Scenario(
        folder=folder,
        scenes=scenes,
        stations=stations,
        receivers=min(sum(found[name].values()) for found in files for name in stations),
        carrier_hz=read_number(params, "carrier_freq", above=0.0),
        files=files,
        transmit_dbm=read_number(params, "transmit_power"),
    )


def _files_of(scene: Path) -> dict[str, dict[Path, int]]:
    """The files of a scene with their numbers of users, by base station, in order."""
    named = [(m, file) for file in scene.iterdir() if (m := _USERS.fullmatch(file.name))]
    found = sorted((int(m[1][2:]), int(m[2]), int(m[3]), m[1], file) for m, file in named)
    by_station: dict[str, dict[Path, int]] = {}
    for _, first, last, station, file in found:
        if last <= first:
            refuse(file, "name", f"users {first} to {last}", "the first before the last")
        by_station.setdefault(station, {})[file] = last - first
    return by_station
