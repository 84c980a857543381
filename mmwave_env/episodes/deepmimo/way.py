"""When a user was at the receivers of a scenario, which stores neither times nor velocities."""

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.deepmimo.paths import TOLERANCE_M
from mmwave_env.episodes.deepmimo.scenario import Scenario
from mmwave_env.episodes.tables import TRAJECTORY, refuse
from mmwave_env.episodes.trajectory import Trajectory, read_trajectory

SIDECAR = "trajectory.csv"  # ours; one row an epoch


def way_of(scenario: Scenario, epochs: NDArray[np.int_], dt_s: float | None) -> Trajectory:
    """Times, positions and velocities of the epochs.

    Args:
        scenario: of the receivers.
        epochs: (E, 2) scenes and rows, as of :meth:`Scenario.epochs`.
        dt_s: between epochs; then velocities are differences of positions. None for those of
            ``trajectory.csv``.

    Raises:
        FileNotFoundError: there is no such file, and no ``dt_s``.
        ValueError: the file is damaged or not at the receivers, or the way is none of a user:
            epochs more than 15 s apart, or a speed that no user has.
    """
    position = scenario.positions(epochs)
    if dt_s is not None:
        if not 0.0 < dt_s < np.inf:
            raise ValueError(f"dt_s: found {dt_s}, expected > 0")
        return Trajectory(f"{scenario.folder}, epochs every {dt_s:g} s",
                          dt_s * np.arange(len(position), dtype=float), position)  # fmt: skip
    file = scenario.folder / SIDECAR
    if not file.exists():
        raise FileNotFoundError(
            f"{file}: found no such file, expected the times and velocities that DeepMIMO does "
            f"not store: a row {','.join(TRAJECTORY)} for each epoch; or dt_s= of "
            "read_deepmimo, the time between them"
        )
    way = read_trajectory(file)
    rows = len(scenario.scenes) if scenario.is_dynamic else scenario.receivers
    if len(way.time_s) != rows:
        what = "scene" if scenario.is_dynamic else "receiver in rx_pos"
        refuse(file, "rows", len(way.time_s), f"{rows}, one for each {what}")
    chosen = np.arange(rows) if scenario.is_dynamic else epochs[:, 1]
    way = Trajectory(
        way.name, way.time_s[chosen], way.position_m[chosen], np.asarray(way.velocity_mps)[chosen],
        np.asarray(way.lines)[chosen].tolist(),
    )  # fmt: skip
    away = np.linalg.norm(way.position_m - position, axis=1) > TOLERANCE_M
    if away.any():
        i = int(np.argmax(away))
        line = np.asarray(way.lines)[i]
        refuse(file, f"line {line}, columns x, y, z", way.position_m[i].tolist(),
               f"{position[i].tolist()}, rx_pos of {scenario.name_of(epochs[i])}")  # fmt: skip
    return way
