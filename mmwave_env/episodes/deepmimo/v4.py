"""DeepMIMO v4 scenario folders: from files to checked paths.

A scenario is a folder with ``params.json`` and one array a file, named
``{key}_t{txset}_tx{tx}_r{rxset}.npz`` (or ``.npy``, ``.mat``). A dynamic one has such files in one
sub-folder a scene, whose sorted order is that of time. Neither times nor velocities are stored.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.deepmimo.array_files import array_shape, find_array, read_array
from mmwave_env.episodes.deepmimo.params import Params
from mmwave_env.episodes.deepmimo.paths import (
    LINE_OF_SIGHT,
    REFLECTION,
    TOLERANCE_M,
    Paths,
    StationPaths,
)
from mmwave_env.episodes.deepmimo.scenario import Scenario, by_scene
from mmwave_env.episodes.tables import refuse
from mmwave_env.lookup import as_name
from mmwave_env.numerics.arrays import Array, Mask

_RECEIVERS = re.compile(r"rx_pos_(t\d+_tx\d+)_r(\d+)\.(?:npz|npy|mat)")


@dataclass(frozen=True, kw_only=True)
class V4Scenario(Scenario):
    """A scenario with one array a file.

    Attributes:
        receiver_set: which set of receivers, such as ``001``.
    """

    receiver_set: str

    def file(self, scene: int, key: str, station: str) -> Path:
        """The file of a key.

        Raises:
            FileNotFoundError: there is none.
        """
        return find_array(self.scenes[scene], f"{key}_{station}_r{self.receiver_set}")

    def grid(self, scene: int = 0) -> Array:
        """Positions (N, 3) of all receivers in a scene, m."""
        return self._positions(scene, None)

    def positions(self, epochs: NDArray[np.int_]) -> Array:
        """Positions (E, 3) of the receivers of epochs, as of :meth:`epochs`, m."""
        return np.concatenate([self._positions(*group) for group in by_scene(epochs)])

    def paths(self, epochs: NDArray[np.int_], base_station: int | None = None) -> Paths:
        """As of :class:`Scenario`; of .npz and .npy files nothing else is kept."""
        return Paths(
            name=as_name(self.folder.resolve().name),
            carrier_hz=self.carrier_hz,
            position_m=self.positions(epochs),
            stations=tuple(_read_station(self, epochs, name) for name in self.chosen(base_station)),
        )

    def _positions(self, scene: int, rows: NDArray[np.int_] | None) -> Array:
        file = self.file(scene, "rx_pos", self.stations[0])
        return _finite(file, "rx_pos", read_array(file, "rx_pos", (self.receivers, 3), rows), rows)


def open_v4(folder: Path, receiver_set: int | None = None) -> V4Scenario:
    """What a folder holds.

    Args:
        folder: of the scenario.
        receiver_set: number of a set of receivers; None for the only one.

    Raises:
        FileNotFoundError: the folder or a file that must be there is missing.
        ValueError: ``params.json`` can't be read or contradicts the files, or there are several
            sets of receivers; the message names them.
    """
    params = Params(folder)
    scenes = _scenes(folder, params)
    number, stations = _stations(scenes[0], receiver_set)
    file = find_array(scenes[0], f"rx_pos_{stations[0]}_r{number}")
    receivers, _ = array_shape(file, "rx_pos", ("N", 3))
    if receivers == 0:
        refuse(file, "rx_pos", "no receivers", "at least one")
    params.require_receivers(int(number), receivers)
    return V4Scenario(
        folder=folder, scenes=scenes, stations=stations, receivers=receivers,
        carrier_hz=params.carrier_hz, receiver_set=number,
    )  # fmt: skip


def _scenes(folder: Path, params: Params) -> tuple[Path, ...]:
    """The folders of the scenes, in the order of time."""
    count = params.scenes
    if count == 1:
        return (folder,)
    found = sorted(sub for sub in folder.iterdir() if sub.is_dir() and any(sub.glob("rx_pos_*")))
    if len(found) != count:
        refuse(params.file, "scene.num_scenes", count,
               f"{len(found)}, the number of sub-folders with receivers")  # fmt: skip
    return tuple(found)


def _stations(scene: Path, receiver_set: int | None) -> tuple[str, tuple[str, ...]]:
    """The set of receivers, and the base stations that have paths to it."""
    links = sorted(m.groups() for f in scene.iterdir() if (m := _RECEIVERS.fullmatch(f.name)))
    if not links:
        raise FileNotFoundError(
            f"{scene}: found no rx_pos_t*_tx*_r*.npz, .npy or .mat, expected the receivers of a "
            "DeepMIMO v4 scenario"
        )
    sets = sorted({number for _, number in links})
    chosen = [n for n in sets if receiver_set is None or int(n) == receiver_set]
    if len(chosen) != 1:
        found = "all" if receiver_set is None else receiver_set
        raise ValueError(f"receiver_set: found {found}, expected one of "
                         f"{', '.join(str(int(n)) for n in sets)} of {scene}")  # fmt: skip
    return chosen[0], tuple(station for station, number in links if number == chosen[0])


def _read_station(scenario: V4Scenario, epochs: NDArray[np.int_], station: str) -> StationPaths:
    scenes = [_read_scene(scenario, scene, station, rows) for scene, rows in by_scene(epochs)]
    here = scenes[0].pop("tx_pos")
    for scene, arrays in enumerate(scenes[1:], start=1):
        moved = arrays.pop("tx_pos")
        if np.linalg.norm(moved - here) > TOLERANCE_M:
            refuse(scenario.file(scene, "tx_pos", station), "tx_pos", moved[0].tolist(),
                   f"{here[0].tolist()}, as in the first scene: a station that stays")  # fmt: skip
    path = {key: _stacked([arrays[key] for arrays in scenes]) for key in scenes[0]}

    def source(key: str, epoch: int) -> tuple[Path, int]:
        scene, row = epochs[epoch].tolist()
        return scenario.file(scene, key, station), row

    return StationPaths(
        name=station,
        position_m=here[0],
        interactions=path["inter"],
        bounce_m=path["inter_pos"],
        gain_db=path["power"],
        delay_s=path["delay"],
        arrival=np.radians(np.stack([path["aoa_az"], path["aoa_el"]], axis=-1)),
        departure=np.radians(np.stack([path["aod_az"], path["aod_el"]], axis=-1)),
        source=source,
    )


def _read_scene(
    scenario: V4Scenario, scene: int, station: str, rows: NDArray[np.int_]
) -> dict[str, Array]:
    """The arrays (R, P, ...) of some receivers in a scene, and ``tx_pos`` (1, 3)."""

    def read(key: str, *shape: int | str, rows: NDArray[np.int_] | None = rows) -> Array:
        return read_array(scenario.file(scene, key, station), key, shape, rows)

    def check(key: str, array: Array, used: Mask | None = None) -> Array:
        return _finite(scenario.file(scene, key, station), key, array, rows, used)

    N = scenario.receivers
    inter = read("inter", N, "P")
    P = inter.shape[1]
    used = (inter == LINE_OF_SIGHT) | (inter == REFLECTION)
    points = read("inter_pos", N, P, "I", 3)  # the largest: what is too much is refused here
    first = points[:, :, 0] if points.shape[2] else np.full((*inter.shape, 3), np.nan)
    arrays = {
        "tx_pos": check("tx_pos", read("tx_pos", 1, 3, rows=None)),
        "inter": inter,
        "inter_pos": check("inter_pos", first, inter == REFLECTION),
    }
    for key in ("power", "delay", "aoa_az", "aoa_el", "aod_az", "aod_el"):
        arrays[key] = check(key, read(key, N, P), used)
    return arrays


def _finite(
    file: Path, key: str, array: Array, rows: NDArray[np.int_] | None, used: Mask | None = None
) -> Array:
    """Refuses NaN and infinity; where ``used`` (R, P) is given only there, with NaN elsewhere."""
    if used is not None:
        used = used.reshape(used.shape + (1,) * (array.ndim - 2))
        array = np.where(used, array, np.nan)
    bad = ~np.isfinite(array) & (True if used is None else used)
    if bad.any():
        at = [int(i) for i in np.argwhere(bad)[0]]
        found = array[tuple(at)]
        at[0] = at[0] if rows is None else int(rows[at[0]])
        refuse(file, f"{key}[{', '.join(map(str, at))}]", found, "a finite number")
    return array


def _stacked(scenes: Sequence[Array]) -> Array:
    """Arrays (R, P, ...) of scenes below each other, with as many paths as most have."""
    most = max(array.shape[1] for array in scenes)
    missing = [[(0, 0), (0, most - a.shape[1]), *[(0, 0)] * (a.ndim - 2)] for a in scenes]
    return np.concatenate(
        [np.pad(a, by, constant_values=np.nan) for a, by in zip(scenes, missing, strict=True)]
    )
