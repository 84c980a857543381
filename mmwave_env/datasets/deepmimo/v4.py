"""Reader of DeepMIMO v4 scenario folders; it also checks the propagation paths in the files.

A scenario is a folder with ``params.json`` and with a file for each array. The file's name is
``{key}_t{txset}_tx{tx}_r{rxset}.npz``. In a dynamic scenario, these files are in
sub-folders, one for each scene (moment in time). Sorted by name, the sub-folders are in the order
of time, but the files contain neither times nor velocities. Pickled objects are refused.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from mmwave_env.datasets.deepmimo.anchors import (
    LINE_OF_SIGHT,
    REFLECTION,
    TOLERANCE_M,
    StationPaths,
)
from mmwave_env.io.files import Json, open_regular, read_json
from mmwave_env.io.records import between, require
from mmwave_env.numerics.numbers import Array, Index, Mask

PARAMS = "params.json"  # the file that marks a folder as a scenario
Hertz = Annotated[float, between(1.0, 1e15)]
_RECEIVERS = re.compile(r"rx_pos_(t\d+_tx\d+)_r(\d+)\.npz")


class Scenario(NamedTuple):
    """A description of a scenario folder, without the propagation paths."""

    folder: Path  # folder of the scenario
    scenes: tuple[Path, ...]  # folder of each scene, in order of time; only ``folder`` if static
    stations: tuple[str, ...]  # names of the base stations, as in the names of the files
    receiver_set: str  # the set of receivers, such as ``001``
    receivers: int  # number of receivers in every scene
    carrier_hz: float

    @property
    def is_dynamic(self) -> bool:
        """Tell whether epochs are successive scenes, not successive receivers on a trajectory."""
        return self.scenes != (self.folder,)

    def epochs(self, users: int | Sequence[int] | Index | None) -> Index:
        """Return pairs (E, 2): for each epoch, its scene and its receiver's row in the arrays.

        Args:
            users: rows of receivers, from 0. For a static scenario, one row per epoch, or None for
                all receivers. For a dynamic scenario, one row per scene or one for all scenes, or
                None if there is only one receiver.

        Raises:
            ValueError: a row does not exist, or the number of rows is wrong.
        """
        rows = np.arange(self.receivers) if users is None else np.atleast_1d(users)
        scenes = np.arange(len(self.scenes)) if self.is_dynamic else np.zeros(rows.size, np.int64)
        exist = rows.dtype.kind in "iu" and np.isin(rows, np.arange(self.receivers)).all()
        if not exist or rows.ndim > 1 or rows.size not in {1, max(len(scenes), 1)}:
            count = f"1 or {len(scenes)} (one for each scene)" if self.is_dynamic else "some"
            raise ValueError(
                f"users: found {users!r}, expected {count} of the receivers 0 to "
                f"{self.receivers - 1} of {self.folder}"
            )
        return np.column_stack([scenes, np.broadcast_to(rows, len(scenes))])

    def file(self, scene: int, key: str, station: str) -> Path:
        """Return the file with the array ``key``."""
        return self.scenes[scene] / f"{key}_{station}_r{self.receiver_set}.npz"

    def positions(self, epochs: Index) -> Array:
        """Return the receivers' positions (E, 3), m, in ``epochs`` (E, 2) from :meth:`epochs`."""
        parts = []
        for scene, own in _by_scene(epochs):
            rows = epochs[own, 1]
            file = self.file(scene, "rx_pos", self.stations[0])
            parts.append(read_array(file, "rx_pos", (self.receivers, 3), rows))
            _require_finite(file, "rx_pos", parts[-1], rows)
        return np.concatenate(parts)

    def paths(self, epochs: Index) -> list[StationPaths]:
        """Read the paths from every base station to some receivers.

        Args:
            epochs: (E, 2) pairs (scene, row) from :meth:`epochs`, in increasing order of scenes.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: a file can't be read or contradicts another file; the message names the file
                and the key.
        """
        return [_read_station(self, epochs, name) for name in self.stations]


def open_scenario(
    folder: Path, receiver_set: int | None = None, base_station: int | None = None
) -> Scenario:
    """Read the description of a scenario folder, but not the propagation paths.

    Args:
        folder: folder of the scenario.
        receiver_set: number of a set of receivers; None for the only set.
        base_station: number of a base station, from 1 in the order of file names; None for all.

    Raises:
        FileNotFoundError: the folder or a required file is missing.
        ValueError: ``params.json`` can't be read or contradicts the files, there is no such
            station, or ``receiver_set`` does not select exactly one set of receivers; the message
            lists the sets.
    """
    carrier_hz, count = _read_params(folder / PARAMS)
    scenes = _scenes(folder, count)
    number, stations = _stations(scenes[0], receiver_set)
    if base_station is not None:
        if base_station not in range(1, len(stations) + 1):
            raise ValueError(
                f"base_station: found {base_station}, expected 1 to {len(stations)}: "
                f"{', '.join(stations)} of {folder}"
            )
        stations = (stations[base_station - 1],)
    file = scenes[0] / f"rx_pos_{stations[0]}_r{number}.npz"
    receivers = len(read_array(file, "rx_pos", ("N", 3)))
    return Scenario(folder, scenes, stations, number, receivers, carrier_hz)


def _read_params(file: Path) -> tuple[float, int]:
    """Read carrier frequency, Hz, and number of scenes; errors name the file and the entry."""

    def make(content: Json) -> tuple[float, int]:
        carrier_hz = content["rt_params"]["frequency"]
        require("rt_params.frequency", carrier_hz, Hertz)
        return float(carrier_hz), content["scene"]["num_scenes"]

    return read_json(file, "the parameters of a DeepMIMO scenario", make)


def _scenes(folder: Path, count: int) -> tuple[Path, ...]:
    """Return the folders of the scenes in order of time."""
    if count == 1:
        return (folder,)
    scenes = sorted(sub for sub in folder.iterdir() if sub.is_dir() and any(sub.glob("rx_pos_*")))
    if len(scenes) != count:
        raise ValueError(
            f"{folder / PARAMS}: scene.num_scenes: found {count!r}, expected {len(scenes)}, the "
            "number of sub-folders with receivers"
        )
    return tuple(scenes)


def _stations(scene: Path, receiver_set: int | None) -> tuple[str, tuple[str, ...]]:
    """Return the names of the set of receivers and of the base stations that have paths to it."""
    links = sorted({m.groups() for f in scene.iterdir() if (m := _RECEIVERS.fullmatch(f.name))})
    if not links:
        raise FileNotFoundError(
            f"{scene}: found no rx_pos_t*_tx*_r*.npz, expected the receivers of a "
            "DeepMIMO v4 scenario"
        )
    sets = sorted({number for _, number in links})
    chosen = [n for n in sets if receiver_set is None or int(n) == receiver_set]
    if len(chosen) != 1:
        known = ", ".join(str(int(n)) for n in sets)
        raise ValueError(
            f"receiver_set: found {receiver_set}, expected one of {known}, the sets in {scene}"
        )
    return chosen[0], tuple(station for station, number in links if number == chosen[0])


def _by_scene(epochs: Index) -> list[tuple[int, Index]]:
    """Return the scenes of epochs (E, 2), each with the indices of its epochs."""
    scenes = epochs[:, 0]
    return [(int(scene), np.flatnonzero(scenes == scene)) for scene in np.unique(scenes)]


def _read_station(scenario: Scenario, epochs: Index, station: str) -> StationPaths:
    scenes = [_read_scene(scenario, station, epochs, *part) for part in _by_scene(epochs)]
    path = {key: np.concatenate([arrays[key] for arrays in scenes]) for key in scenes[0]}
    places = path["tx_pos"]
    moved = np.linalg.norm(places - places[0], axis=1) > TOLERANCE_M
    if moved.any():
        scene = int(np.argmax(moved))
        raise ValueError(
            f"{scenario.file(scene, 'tx_pos', station)}: tx_pos: found {places[scene].tolist()}, "
            f"expected {places[0].tolist()}, as in the first scene: stations must not move"
        )

    def source(key: str, epoch: int) -> tuple[Path, int]:
        scene, row = epochs[epoch].tolist()
        return scenario.file(scene, key, station), row

    return StationPaths(
        position_m=places[0],
        epoch=path["epoch"],
        path=path["path"],
        is_reflected=path["inter"] == REFLECTION,
        bounce_m=path["inter_pos"],
        gain_db=path["power"],
        delay_s=path["delay"],
        arrival=np.radians(np.column_stack([path["aoa_az"], path["aoa_el"]])),
        departure=np.radians(np.column_stack([path["aod_az"], path["aod_el"]])),
        source=source,
    )


def _read_scene(
    scenario: Scenario, station: str, epochs: Index, scene: int, own: Index
) -> dict[str, Array]:
    """Read the arrays (n, ...) of the paths in a scene, and ``tx_pos`` (1, 3).

    Paths that are neither lines of sight nor single reflections are left out. ``own`` are the
    indices of the scene's epochs.
    """
    receivers = epochs[own, 1]

    def read(key: str, *shape: int | str) -> Array:
        return read_array(scenario.file(scene, key, station), key, shape, receivers)

    N = scenario.receivers
    inter = read("inter", N, "P")
    P = inter.shape[1]
    points = read("inter_pos", N, P, "I", 3)
    bounce = points[:, :, 0] if points.shape[2] else np.full((*inter.shape, 3), np.nan)
    reflected = inter == REFLECTION
    used = reflected | (inter == LINE_OF_SIGHT)
    keys = ("power", "delay", "aoa_az", "aoa_el", "aod_az", "aod_el")
    arrays = {key: read(key, N, P) for key in keys} | {"inter_pos": bounce}
    for key, array in arrays.items():
        needed = reflected[..., None] if key == "inter_pos" else used
        _require_finite(scenario.file(scene, key, station), key, array, receivers, needed)
    file = scenario.file(scene, "tx_pos", station)
    here = read_array(file, "tx_pos", (1, 3))
    _require_finite(file, "tx_pos", here, range(1))
    epoch, path = np.nonzero(used)
    of_paths = {key: array[used] for key, array in (arrays | {"inter": inter}).items()}
    return of_paths | {"tx_pos": here, "epoch": own[epoch], "path": path}


def _require_finite(
    file: Path, key: str, array: Array, rows: Index | range, needed: Mask | bool = True
) -> None:
    """Refuse NaN and infinity in an array (R, ...) of receivers' ``rows``, where it is needed."""
    bad = ~np.isfinite(array) & needed
    if bad.any():
        row, *rest = index = np.argwhere(bad)[0].tolist()
        place = ", ".join(map(str, [rows[row], *rest]))
        number = array[tuple(index)]
        raise ValueError(f"{file}: {key}[{place}]: found {number}, expected a finite number")


def read_array(
    file: Path, key: str, shape: tuple[int | str, ...], rows: Index | None = None
) -> Array:
    """Read, as doubles, the array stored under a key in a file.

    Args:
        file, key: the file, and the name of the array.
        shape: shape of the complete array; a letter stands for any length.
        rows: (R,) indices of the rows to return, in any order; None for all.

    Raises:
        OSError: the file can't be opened; FileNotFoundError if there is none.
        ValueError: the array can't be read, has numbers that are not real or has another shape;
            the message names file and key.
    """
    stream = open_regular(file, "an .npz file, as DeepMIMO 4 writes it")
    try:
        with stream, np.load(stream, allow_pickle=False) as arrays:
            stored = arrays[key]
    except Exception as error:  # numpy, zipfile and zlib raise many kinds for damaged files
        raise ValueError(
            f"{file}: {key}: found no readable array ({' '.join(str(error).split())}), expected an "
            ".npz file of numbers"
        ) from error
    if stored.dtype.kind not in "fiu":
        raise ValueError(f"{file}: {key}: found type {stored.dtype}, expected real numbers")
    pairs = zip(shape, stored.shape, strict=False)
    wanted = tuple(n if isinstance(length, str) else length for length, n in pairs)
    if len(shape) != stored.ndim or stored.shape != wanted:
        expected = ", ".join(map(str, shape))
        raise ValueError(f"{file}: {key}: found shape {stored.shape}, expected shape ({expected})")
    return np.array(stored if rows is None else stored[rows], float)
