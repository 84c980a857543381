"""DeepMIMO scenarios, read as recordings of one user.

:mod:`~mmwave_env.datasets.deepmimo.v4` reads the paths that a scenario lists, and
:mod:`~mmwave_env.datasets.deepmimo.anchors` finds the anchors that these paths lead to.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmwave_env.datasets.deepmimo.anchors import TOLERANCE_M, StationLinks, StationPaths, find_links
from mmwave_env.datasets.deepmimo.v4 import Scenario, open_scenario
from mmwave_env.datasets.recorded import Recording
from mmwave_env.datasets.ways import COLUMNS, read_trajectory
from mmwave_env.io.files import AnyPath
from mmwave_env.io.lookup import as_name
from mmwave_env.models.layout import LINK
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.world.trajectory import Trajectory

SIDECAR = "trajectory.csv"  # times, positions and perhaps velocities; not a file of DeepMIMO


def read_deepmimo(
    folder: AnyPath,
    virtual_anchors: int = 2,
    *,
    dt_s: float | None = None,
    users: int | Sequence[int] | Index | None = None,
    base_station: int | None = None,
    receiver_set: int | None = None,
) -> Recording:
    """Read a scenario folder as a recording.

    In a static scenario, the epochs are successive receivers on the user's trajectory; in a dynamic
    scenario, they are successive scenes (moments in time). Times and velocities come from the file
    ``trajectory.csv`` in the folder, with a row for each receiver (static) or scene (dynamic).

    If there is only one station, or ``base_station`` selects one, the anchors are this station and
    its mirror images. Otherwise the anchors are all stations that are ever in sight, the most often
    seen station first. The first anchor's Doppler shift is computed from the true velocity.

    Args:
        folder: folder of a DeepMIMO v4 scenario.
        virtual_anchors: maximum number of mirror images; those seen most often are kept.
        dt_s: time step to use instead of ``trajectory.csv``; velocities are then computed from the
            positions.
        users: indices of receivers, from 0. For a static scenario, one index per epoch; for a
            dynamic scenario, one index for all scenes, or one index per scene.
        base_station: number of the only station to use, from 1 in the order of file names.
        receiver_set: number of the set of receivers, if there are several sets.

    Raises:
        FileNotFoundError: the folder or one of its files is missing.
        ValueError: a file is damaged, contradicts another file or is not supported;
            the message names file, key, value and what was expected.
    """
    if virtual_anchors < 0:
        raise ValueError(f"virtual_anchors: found {virtual_anchors}, expected at least 0")
    scenario = open_scenario(Path(folder), receiver_set, base_station)
    receivers = scenario.epochs(users)
    way = _way_of(scenario, receivers, dt_s)
    stations = scenario.paths(receivers)
    links = _links(stations, way.position_m, virtual_anchors)
    return _recording(scenario, links, way)


def _recording(
    scenario: Scenario,
    links: Sequence[tuple[StationLinks, int]],
    way: Trajectory,
) -> Recording:
    """Return a recording of the strongest path to each anchor of ``links`` (:func:`_links`)."""
    shape = (len(way.time_s), len(links))
    rows = np.full((*shape, len(LINK)), np.nan)
    gain_db = np.full(shape, np.nan)
    for a, (station, k) in enumerate(links):
        strongest = station.strongest(k)
        epochs = station.paths.epoch[strongest]
        rows[epochs, a] = station.rows[strongest]
        gain_db[epochs, a] = station.paths.gain_db[strongest]
    values: dict[str, Any] = {name: rows[..., i] for i, name in enumerate(LINK)}
    return Recording.from_arrays(
        time_s=way.time_s,
        anchors_m=[station.anchors_m[k] for station, k in links],
        **values,
        path_gain_db=gain_db,
        position_m=way.position_m,
        velocity_mps=way.velocity_mps,
        carrier_hz=scenario.carrier_hz,
        name=as_name(scenario.folder.resolve().name),
    )


def _way_of(scenario: Scenario, epochs: Index, dt_s: float | None) -> Trajectory:
    """Return times, positions and velocities for epochs (E, 2), which are pairs (scene, receiver).

    With ``dt_s``, velocities are computed from the positions; without it, times and velocities
    come from ``trajectory.csv``.

    Raises:
        FileNotFoundError: ``dt_s`` is None, and ``trajectory.csv`` is missing.
        ValueError: the file is damaged, its positions differ from the receivers' positions, epochs
            are more than 15 s apart, or the speed is impossible for a user.
    """
    position = scenario.positions(epochs)
    if dt_s is not None:
        if not 0.0 < dt_s < np.inf:
            raise ValueError(f"dt_s: found {dt_s}, expected > 0")
        time_s = dt_s * np.arange(len(position), dtype=float)
        return Trajectory(f"{scenario.folder}, epochs every {dt_s:g} s", time_s, position)
    file = scenario.folder / SIDECAR
    if not file.exists():
        raise FileNotFoundError(
            f"{file}: found no such file, expected the times and velocities that DeepMIMO does "
            f"not store: a row {','.join(COLUMNS)} for each receiver (in a dynamic scenario: for "
            "each scene); or pass dt_s=, the time between epochs, to read_deepmimo"
        )
    way = read_trajectory(file)
    rows = len(scenario.scenes) if scenario.is_dynamic else scenario.receivers
    if len(way.time_s) != rows:
        owner = "scene" if scenario.is_dynamic else "receiver in rx_pos"
        raise ValueError(
            f"{file}: rows: found {len(way.time_s)}, expected {rows}, one for each {owner}"
        )
    chosen = np.arange(rows) if scenario.is_dynamic else epochs[:, 1]
    velocity = np.asarray(way.velocity_mps)[chosen]
    lines = np.asarray(way.lines)[chosen]
    way = Trajectory(way.name, way.time_s[chosen], way.position_m[chosen], velocity, lines.tolist())
    away = np.linalg.norm(way.position_m - position, axis=1) > TOLERANCE_M
    if away.any():
        i = int(np.argmax(away))
        raise ValueError(
            f"{file}: line {np.asarray(way.lines)[i]}, columns x, y, z: found "
            f"{way.position_m[i].tolist()}, expected {position[i].tolist()}, as in rx_pos"
        )
    return way


def _links(
    stations: list[StationPaths], position_m: Array, virtual_anchors: int
) -> list[tuple[StationLinks, int]]:
    """Return a pair (links, k) for each anchor, so that the anchor is ``links.anchors_m[k]``."""
    if len(stations) == 1:
        links = find_links(stations[0], position_m)
        images = np.flatnonzero(~links.is_ground)[1:].tolist()
        images.sort(key=lambda k: -len(links.strongest(k)))
        return [(links, k) for k in [0, *images[:virtual_anchors]]]
    in_sight = [station for station in stations if not station.is_reflected.all()]
    if not in_sight:
        stations[0].refuse(
            "inter",
            0,
            "no line of sight (0)",
            "a line of sight in this file or in the file of another station",
        )
    by_station = [find_links(station, position_m) for station in in_sight]
    return [(links, 0) for links in sorted(by_station, key=lambda links: -len(links.strongest(0)))]
