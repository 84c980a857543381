"""History of an episode: the epochs so far, from which a picture is drawn."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.models.scene import Streets
from mmwave_env.numerics.numbers import Array, Index, Mask

NO_MODE = -1  # mode number of the prior, which no mode computed
POSITION_NUMBERS = 6  # a packed covariance begins with this many entries about the position


class Scenery(NamedTuple):
    """The data that stay the same through an episode."""

    name: str  # name of the episode
    anchors_m: Array  # (L, 3) positions, the base station first
    streets: Streets | None  # streets of the map; None if unknown


@dataclass(frozen=True, eq=False)
class History:
    """The prior and the k epochs after it, as rows of arrays; the first row is the prior."""

    scenery: Scenery  # data that stay the same through the episode
    axes: int  # number of position axes that NEES covers
    time_s: Array  # (k + 1,) time since the first epoch
    modes: Index  # (k + 1,) number of the mode that ran; ``NO_MODE`` in the first row
    truth: Array  # (k + 1, 6) position (m), velocity (m/s)
    estimate: Array  # (k + 1, 7 or 8) position (m), velocity (m/s), bias (Hz), maybe range bias (m)
    P: Array  # (k + 1, 6) covariance of the position (m^2), packed: xx, xy, yy, xz, yz, zz
    nees: Array  # (k + 1,) NEES; NaN in the first row
    # accepted, rejected: (k + 1, groups) decisions of the gate; the groups are the links, the
    # Doppler shift and (if measured) odometry. A missing group is neither accepted nor rejected.
    accepted: Mask
    rejected: Mask

    @property
    def epochs(self) -> int:
        """Return the number of processed epochs."""
        return len(self.modes) - 1

    @cached_property
    def error_m(self) -> Array:
        """Return the length (k + 1,) of the position error."""
        return np.linalg.norm(self.estimate[:, :3] - self.truth[:, :3], axis=1)  # type: ignore[no-any-return]

    def part(self, rows: slice) -> "History":
        """Return a history with only these rows."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays = {key: of for key, of in own.items() if isinstance(of, np.ndarray)}
        parts: dict[str, Any] = {key: of[rows] for key, of in arrays.items()}
        return replace(self, **parts)


class Recorder:
    """A recorder that copies epochs from a workspace, the array of all numbers of an environment.

    Args:
        rows: by name, the slices of the workspace that contain ``anchors``, ``truth``,
            ``estimate``, ``P`` (packed), ``accepted`` and ``rejected``, and the indices of ``nees``
            and ``dt`` (seconds until the next epoch).
        axes: number of position axes that NEES covers.
    """

    def __init__(self, rows: Mapping[str, Any], axes: int) -> None:
        P = slice(rows["P"].start, rows["P"].start + POSITION_NUMBERS)
        self._rows = {**rows, "P": P}
        self._axes = axes
        self._scenery = Scenery("", np.zeros((0, 3)), None)
        self._modes: list[int] = []
        self._epochs: list[dict[str, Array]] = []

    def begin(self, name: str, streets: Streets | None, workspace: Array) -> None:
        """Start a new recording with the prior in the workspace (size,)."""
        anchors_m = workspace[self._rows["anchors"]].reshape(-1, 3).copy()
        self._scenery = Scenery(name, anchors_m, streets)
        self._modes = []
        self._epochs = []
        self.add(workspace, NO_MODE)

    def add(self, workspace: Array, mode: int) -> None:
        """Record the epoch that a mode just processed."""
        self._modes.append(mode)
        self._epochs.append({key: workspace[rows].copy() for key, rows in self._rows.items()})

    @property
    def history(self) -> History:
        """Return all epochs so far."""
        part = {key: np.array([epoch[key] for epoch in self._epochs]) for key in self._rows}
        time_s = np.cumsum(np.append(0.0, part["dt"][:-1]))
        part["nees"][0] = np.nan  # the workspace still has the previous episode's NEES
        states = part["truth"], part["estimate"], part["P"], part["nees"]
        gates = part["accepted"] > 0.5, part["rejected"] > 0.5
        modes = np.array(self._modes)
        return History(self._scenery, self._axes, time_s, modes, *states, *gates)
