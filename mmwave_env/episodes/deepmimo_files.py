"""DeepMIMO v4 scenario folders: from files to checked arrays, in the files' own meaning.

A scenario is a folder with ``params.json`` and one array a file, named
``{key}_t{txset}_tx{tx}_r{rxset}.npz`` (or ``.npy``). It stores neither times nor velocities;
ours has them in a sidecar, ``trajectory.csv`` (t, x, y, z, vx, vy, vz), one row a receiver.
:mod:`mmwave_env.episodes.deepmimo` makes sense of the arrays.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.tables import TRAJECTORY, read_table, refuse
from mmwave_env.numerics.arrays import Array

PARAMS = "params.json"  # by which a folder is known as a scenario
LINE_OF_SIGHT, REFLECTION = 0.0, 1.0  # values of ``inter`` that are understood here
TOLERANCE_M = 0.05  # float32 files agree to 1e-4 m; walls and sidecars closer than this are one
_HIGHEST_HZ = 1e15
_PATH_KEYS = ("power", "delay", "aoa_az", "aoa_el", "aod_az", "aod_el")


@dataclass(frozen=True, eq=False)
class Scenario:
    """A static scenario with one transmitter, whose N receivers are the epochs of one track.

    Paths with ``interactions`` 0 or 1 are finite, all others NaN.
    """

    folder: Path  # where it was read
    link: str  # the part of the file names that tells transmitter and receivers
    carrier_hz: float  # carrier frequency
    transmitter_m: Array  # (3,)
    time_s: Array  # (N,) increasing
    # position_m, velocity_mps: (N, 3) of the receiver
    position_m: Array
    velocity_mps: Array
    # (N, P) digits from transmitter to receiver; 0 line of sight, 1 one reflection; NaN no path
    interactions: Array
    bounce_m: Array  # (N, P, 3) first point of interaction
    power_db: Array  # (N, P) path gain, 20 log10 |a|
    delay_s: Array  # (N, P) absolute
    # arrival, departure: (N, P, 2) azimuth and zenith angle, rad
    arrival: Array
    departure: Array

    def refuse(self, key: str, found: str, expected: str) -> NoReturn:
        """Raise a ValueError about the contents of a key's file."""
        refuse(_array_path(self.folder, key, self.link), key, found, expected)


def read_scenario(folder: Path) -> Scenario:
    """Read and check a scenario.

    Raises:
        FileNotFoundError: the folder or a file that must be there is missing.
        ValueError: a file can't be read, contradicts another, or holds what is not understood.
    """
    if not folder.exists():
        raise FileNotFoundError(f"{folder}: found nothing, expected the folder of a scenario")
    if not folder.is_dir():
        refuse(folder, "folder", "a file", "the folder of a DeepMIMO v4 scenario")
    params = _read_params(folder / PARAMS)
    link = _find_link(folder)

    def read(key: str, *shape: int | str) -> Array:
        return _read_array(_array_path(folder, key, link), key, shape)

    def check(key: str, array: Array, used: NDArray[np.bool_] | None = None) -> Array:
        return _finite(_array_path(folder, key, link), key, array, used)

    receivers_m = check("rx_pos", read("rx_pos", "N", 3))
    N = len(receivers_m)
    if N == 0:
        refuse(_array_path(folder, "rx_pos", link), "rx_pos", "no receivers", "at least one")
    _check_receivers(folder / PARAMS, params, link, N)
    trajectory = _read_trajectory(folder / "trajectory.csv", receivers_m)
    interactions = read("inter", N, "P")
    P = interactions.shape[1]
    used = (interactions == LINE_OF_SIGHT) | (interactions == REFLECTION)
    path = {key: check(key, read(key, N, P), used) for key in _PATH_KEYS}
    points = read("inter_pos", N, P, "I", 3)
    if points.shape[2] == 0:
        points = np.full((N, P, 1, 3), np.nan)
    return Scenario(
        folder=folder,
        link=link,
        carrier_hz=_carrier_hz(folder / PARAMS, params),
        transmitter_m=check("tx_pos", read("tx_pos", 1, 3))[0],
        time_s=trajectory[:, 0],
        position_m=trajectory[:, 1:4],
        velocity_mps=trajectory[:, 4:],
        interactions=interactions,
        bounce_m=check("inter_pos", points[:, :, 0], interactions == REFLECTION),
        power_db=path["power"],
        delay_s=path["delay"],
        arrival=np.radians(np.stack([path["aoa_az"], path["aoa_el"]], axis=-1)),
        departure=np.radians(np.stack([path["aod_az"], path["aod_el"]], axis=-1)),
    )


def _read_params(file: Path) -> dict[str, Any]:
    """``params.json`` of a static scenario."""
    _require_file(file)
    try:
        params = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise ValueError(f"{file}: found no readable JSON ({error}), expected JSON") from error
    scenes = _entry(file, params, "scene", "num_scenes")
    if scenes != 1:
        refuse(file, "scene.num_scenes", scenes, "1: a static scenario, whose receivers are the "
               "epochs of a track")  # fmt: skip
    return dict(params)


def _entry(file: Path, tree: Any, *keys: str) -> Any:
    """What stands under nested keys of a JSON document."""
    for depth, key in enumerate(keys):
        if not isinstance(tree, dict) or key not in tree:
            refuse(file, ".".join(keys[: depth + 1]), "nothing", "an entry")
        tree = tree[key]
    return tree


def _carrier_hz(file: Path, params: dict[str, Any]) -> float:
    frequency = _entry(file, params, "rt_params", "frequency")
    is_number = isinstance(frequency, (int, float)) and not isinstance(frequency, bool)
    if not is_number or not 0.0 < frequency < _HIGHEST_HZ:
        refuse(file, "rt_params.frequency", repr(frequency), "a positive number of hertz")
    return float(frequency)


def _check_receivers(file: Path, params: dict[str, Any], link: str, receivers: int) -> None:
    """Refuse a set of receivers of another size than ``receivers``."""
    sets = _entry(file, params, "txrx_sets")
    number = int(link[link.rindex("r") + 1 :])
    for name in sets if isinstance(sets, dict) else ():
        if _entry(file, params, "txrx_sets", name, "id") == number:
            points = _entry(file, params, "txrx_sets", name, "num_points")
            if points != receivers:
                refuse(file, f"txrx_sets.{name}.num_points", points,
                       f"{receivers}, the number of receivers in rx_pos_{link}")  # fmt: skip
            return
    refuse(file, "txrx_sets", "no such set", f"the set of receivers with id {number}")


def _find_link(folder: Path) -> str:
    """The part of the file names that tells transmitter and receivers; there must be one."""
    pattern = re.compile(r"rx_pos_(t\d+_tx\d+_r\d+)\.(npz|npy|mat)")
    links = sorted({m[1] for file in folder.iterdir() if (m := pattern.fullmatch(file.name))})
    if not links:
        raise FileNotFoundError(
            f"{folder}: found no rx_pos_t*_tx*_r*.npz or .npy, expected the receivers of a "
            "DeepMIMO v4 scenario"
        )
    if len(links) > 1:
        refuse(folder, "rx_pos", ", ".join(links), "one transmitter and one set of receivers: "
               "copy those you want, and params.json, into a folder of their own")  # fmt: skip
    return links[0]


def _array_path(folder: Path, key: str, link: str) -> Path:
    """A key's file: .npz, or else .npy where there is one."""
    compressed, plain = (folder / f"{key}_{link}{ending}" for ending in (".npz", ".npy"))
    return plain if plain.exists() and not compressed.exists() else compressed


def _require_file(file: Path) -> None:
    if not file.exists():
        raise FileNotFoundError(f"{file}: found no such file in the scenario, expected one")


def _read_array(file: Path, key: str, shape: tuple[int | str, ...]) -> Array:
    """The array of a key; a letter in ``shape`` stands for any length."""
    if not file.exists() and file.with_suffix(".mat").exists():
        refuse(file.with_suffix(".mat"), key, "a MATLAB file", ".npz or .npy")
    _require_file(file)
    try:
        # Pickled objects are refused: unpickling a stranger's file runs a stranger's code.
        with file.open("rb") as opened:  # numpy leaves one open that is no zip file after all
            loaded = np.load(opened, allow_pickle=False)
            arrays = {key: loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except Exception as error:  # numpy, zipfile and zlib raise many kinds for a damaged file
        raise ValueError(
            f"{file}: {key}: found no readable array ({error}), expected an .npz or .npy file "
            "of numbers"
        ) from error
    if key not in arrays:
        refuse(file, key, f"only {', '.join(arrays) or 'nothing'}", f"an array named {key}")
    array = np.asarray(arrays[key])
    if array.dtype.kind not in "fiu":
        refuse(file, key, f"type {array.dtype}", "real numbers")
    if len(array.shape) != len(shape) or any(
        isinstance(length, int) and length != found
        for found, length in zip(array.shape, shape, strict=True)
    ):
        refuse(file, key, f"shape {array.shape}", f"shape ({', '.join(map(str, shape))})")
    return array.astype(float)


def _finite(file: Path, key: str, array: Array, used: NDArray[np.bool_] | None) -> Array:
    """Refuses NaN and infinity; where ``used`` (N, P) is given only there, with NaN elsewhere."""
    if used is not None:
        used = used.reshape(used.shape + (1,) * (array.ndim - 2))
        array = np.where(used, array, np.nan)
    bad = ~np.isfinite(array) & (True if used is None else used)
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        refuse(file, f"{key}[{', '.join(map(str, at))}]", array[at], "a finite number")
    return array


def _read_trajectory(file: Path, receivers_m: Array) -> Array:
    """Rows (N, 7) of the sidecar: t, x, y, z, vx, vy, vz; at the receivers (N, 3)."""
    if not file.exists():
        raise FileNotFoundError(
            f"{file}: found no such file, expected the times and velocities that DeepMIMO does "
            f"not store: a row {','.join(TRAJECTORY)} for each receiver"
        )
    lines, track = read_table(file, TRAJECTORY)
    if len(track) != len(receivers_m):
        refuse(file, "rows", len(track), f"{len(receivers_m)}, one for each receiver in rx_pos")
    for i, line in enumerate(lines):
        if i and not track[i, 0] > track[i - 1, 0]:
            refuse(file, f"line {line}, column t", track[i, 0], f"more than {track[i - 1, 0]}")
        if not np.linalg.norm(track[i, 1:4] - receivers_m[i]) <= TOLERANCE_M:
            refuse(file, f"line {line}, columns x, y, z", track[i, 1:4].tolist(),
                   f"{receivers_m[i].tolist()}, rx_pos of receiver {i}")  # fmt: skip
    return track
