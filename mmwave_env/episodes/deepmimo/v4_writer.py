"""Paths as a static DeepMIMO v4 scenario, whose receivers are the epochs of a track.

Arrays are float32, as the format has them: seven digits. Times, positions and velocities stand
beside them in ``trajectory.csv``, to the last digit.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mmwave_env.episodes.deepmimo.params import PARAMS
from mmwave_env.episodes.deepmimo.paths import Paths, StationPaths
from mmwave_env.episodes.deepmimo.way import SIDECAR
from mmwave_env.episodes.tables import TRAJECTORY
from mmwave_env.files import atomic_path, write_json, write_text
from mmwave_env.numerics.arrays import Array

OBJECTS = "objects.json"


def write_v4(
    folder: Path, paths: Paths, time_s: Array, velocity_mps: Array, raytracer: Mapping[str, Any]
) -> list[str]:
    """Write the paths of a track as a scenario; the names of the files.

    There are no buildings in it. ``params.json`` comes last: a folder without it is no scenario.

    Args:
        folder: made where it is not there.
        paths: of E receivers.
        time_s: (E,) when the user was at them, increasing.
        velocity_mps: (E, 3) of the user.
        raytracer: entries of ``rt_params`` that say how the paths were found.

    Raises:
        ValueError: arrays of another scenario lie in the folder.
        OSError: a file can't be written.
    """
    arrays = {"vertices": np.empty((0, 3))}
    for tx, station in enumerate(paths.stations):
        for key, array in _arrays(paths.position_m, station).items():
            arrays[f"{key}_t000_tx{tx:03}_r001"] = array
    _require_no_others(folder, arrays)
    (folder / PARAMS).unlink(missing_ok=True)
    for name, array in arrays.items():
        with atomic_path(folder / f"{name}.npz") as file:
            single: Any = {name.partition("_t0")[0]: array.astype(np.float32)}
            np.savez_compressed(file, **single)
    track = np.column_stack([time_s, paths.position_m, velocity_mps])
    rows = [TRAJECTORY, *(map(repr, row) for row in track.tolist())]
    write_text(folder / SIDECAR, "".join(",".join(row) + "\n" for row in rows))
    write_text(folder / OBJECTS, "[]\n")
    write_json(folder / PARAMS, _params(paths, raytracer))
    return [PARAMS, OBJECTS, SIDECAR, *(f"{name}.npz" for name in arrays)]


def _require_no_others(folder: Path, names: Collection[str]) -> None:
    """Refuse a folder with arrays of other names, which would be read with the new ones."""
    others = [file.name for file in folder.glob("*_t*_tx*_r*") if file.stem not in names]
    if others:
        raise ValueError(
            f"{folder}: found {min(others)} of another scenario, expected only files that are "
            "written anew; name another folder"
        )


def _arrays(position_m: Array, station: StationPaths) -> dict[str, Array]:
    """The arrays of a station, by key."""
    there = np.isfinite(station.interactions)
    phase = np.where(there, 0.0, np.nan) if station.phase_rad is None else station.phase_rad
    aoa, aod = np.degrees(station.arrival), np.degrees(station.departure)
    return {
        "rx_pos": position_m,
        "tx_pos": station.position_m[None],
        "inter": station.interactions,
        "inter_pos": station.bounce_m[:, :, None],
        "power": station.gain_db,
        "phase": np.degrees(phase),
        "delay": station.delay_s,
        "aoa_az": aoa[..., 0],
        "aoa_el": aoa[..., 1],
        "aod_az": aod[..., 0],
        "aod_el": aod[..., 1],
    }


def _params(paths: Paths, raytracer: Mapping[str, Any]) -> dict[str, Any]:
    """What ``params.json`` says; the format wants every entry."""
    return {
        "version": "4.0.0",
        "rt_params": {
            "raytracer_name": "mmwave-loc", "raytracer_version": "",
            "frequency": paths.carrier_hz,
            "max_path_depth": 1, "max_reflections": 1, "max_diffractions": 0,
            "max_scattering": 0, "max_transmissions": 0,
            "diffuse_reflections": 0, "diffuse_diffractions": 0, "diffuse_transmissions": 0,
            "diffuse_final_interaction_only": False, "diffuse_random_phases": False,
            "terrain_reflection": False, "terrain_diffraction": False, "terrain_scattering": False,
            "num_rays": 0, "ray_casting_method": "uniform", "synthetic_array": True,
            "ray_casting_range_az": 360.0, "ray_casting_range_el": 180.0,
            "gps_bbox": [0, 0, 0, 0], "raw_params": {},
            **raytracer,
        },
        "txrx_sets": {
            "txrx_set_0": _set("base station", 0, True, len(paths.stations)),
            "txrx_set_1": _set("user", 1, False, len(paths.position_m)),
        },
        "scene": {
            "num_scenes": 1, "n_objects": 0, "n_vertices": 0, "n_faces": 0, "n_triangular_faces": 0
        },
        "materials": {},
    }  # fmt: skip


def _set(name: str, number: int, sends: bool, points: int) -> dict[str, Any]:
    """An entry of ``txrx_sets``: isotropic single antennas."""
    return {
        "name": name, "id": number, "id_orig": number, "is_tx": sends, "is_rx": not sends,
        "num_points": points, "num_active_points": points, "num_ant": 1, "dual_pol": False,
        "ant_rel_positions": [[0.0, 0.0, 0.0]], "array_orientation": [0.0, 0.0, 0.0],
    }  # fmt: skip
