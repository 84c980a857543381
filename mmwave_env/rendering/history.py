"""History of an episode: the epochs so far, from which a picture is drawn."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index, Mask

NO_MODE = -1  # mode number of the prior, which no mode computed
POSITION_NUMBERS = 6  # a packed covariance begins with this many entries about the position


class History(NamedTuple):
    """The prior and the k epochs after it, as rows of arrays; the first row is the prior."""

    name: str  # name of the episode
    anchors_m: Array  # (L, 3) positions, the base station first
    scene: Scene | None  # scene whose streets and walls the map shows; None if unknown
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

    @property
    def error_m(self) -> Array:
        """Return the length (k + 1,) of the position error."""
        with np.errstate(over="ignore"):  # the error of a lost track may be arbitrarily large
            return np.linalg.norm(self.estimate[:, :3] - self.truth[:, :3], axis=1)  # type: ignore[no-any-return]

    def part(self, rows: slice) -> "History":
        """Return a history with only these rows."""
        arrays: Any = self[4:]
        return History(*self[:4], *(array[rows] for array in arrays))


class Recorder:
    """A recorder that copies epochs from a workspace, the array of all numbers of an environment.

    It begins with the prior.

    Args:
        rows: by name, the slices of the workspace that contain ``anchors``, ``truth``,
            ``estimate``, ``P`` (packed), ``accepted`` and ``rejected``, and the indices of ``nees``
            and ``dt`` (seconds until the next epoch).
        axes: number of position axes that NEES covers.
        name: name of the episode.
        scene: scene whose streets and walls the map shows; None if unknown.
        workspace: (size,) workspace with the prior.
    """

    def __init__(
        self,
        rows: Mapping[str, Any],
        axes: int,
        name: str,
        scene: Scene | None,
        workspace: Array,
    ) -> None:
        P = slice(rows["P"].start, rows["P"].start + POSITION_NUMBERS)
        self._rows = {**rows, "P": P}
        anchors_m = workspace[rows["anchors"]].reshape(-1, 3).copy()
        self._episode = (name, anchors_m, scene, axes)
        self._modes: list[int] = []
        self._epochs: list[dict[str, Array]] = []
        self.add(workspace, NO_MODE)

    def add(self, workspace: Array, mode: int) -> None:
        """Record the epoch that a mode just processed."""
        self._modes.append(mode)
        self._epochs.append({key: workspace[rows].copy() for key, rows in self._rows.items()})

    @property
    def history(self) -> History:
        """Return all epochs so far."""
        part = {key: np.array([epoch[key] for epoch in self._epochs]) for key in self._rows}
        part["nees"][0] = np.nan  # the workspace still has the previous episode's NEES
        return History(
            *self._episode,
            np.cumsum(np.append(0.0, part["dt"][:-1])),
            np.array(self._modes),
            *(part[key] for key in ("truth", "estimate", "P", "nees")),
            *(part[key] > 0.5 for key in ("accepted", "rejected")),
        )
