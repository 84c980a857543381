"""History of an episode: the epochs so far, from which a picture is drawn."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.models.scene import Streets
from mmwave_env.numerics.numbers import Array, Index, Mask

NO_MODE = -1  # for the prior, which no mode computed
POSITION_NUMBERS = 6  # the first values of a packed covariance belong to the position


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
    estimate: Array  # (k + 1, 7) position (m), velocity (m/s), bias (Hz)
    P: Array  # (k + 1, 6) covariance of the position, packed: xx, xy, yy, xz, yz, zz, m^2
    nees: Array  # (k + 1,), NaN in the first row
    # accepted, rejected: (k + 1, groups) links first, then the Doppler shift
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

    @cached_property
    def error_95_m(self) -> Array:
        """Return the radius (k + 1,) within which 95 % of the errors are expected, given P.

        The squared error of a Gaussian belief is a weighted sum of chi-squares, approximated by a
        scaled chi-square with the same mean and variance (Satterthwaite).
        """
        from scipy.special import chdtri

        xx, xy, yy, xz, yz, zz = self.P.T
        if self.axes == 2:
            xz, yz, zz = 0.0 * xz, 0.0 * yz, 0.0 * zz
        mean = xx + yy + zz
        square = xx**2 + yy**2 + zz**2 + 2.0 * (xy**2 + xz**2 + yz**2)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(square / mean * chdtri(mean**2 / square, 0.05))  # type: ignore[no-any-return]

    def until(self, epochs: int) -> "History":
        """Return the history as it was after this number of epochs."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays = {key: of for key, of in own.items() if isinstance(of, np.ndarray)}
        rows: dict[str, Any] = {key: of[: epochs + 1] for key, of in arrays.items()}
        return replace(self, **rows)


class Recorder:
    """Recorder of an environment's epochs, from its workspace (all its values in one array).

    Args:
        rows: slices of the workspace that contain ``anchors``, ``dt`` of the next epoch, ``truth``,
            ``estimate``, ``P`` (packed), ``nees``, ``accepted`` and ``rejected``.
        axes: number of position axes that NEES covers.
    """

    def __init__(self, rows: Mapping[str, slice], axes: int) -> None:
        P = slice(rows["P"].start, rows["P"].start + POSITION_NUMBERS)
        self._rows, self._axes = {**rows, "P": P}, axes
        self._scenery = Scenery("", np.zeros((0, 3)), None)
        self._epochs: dict[str, list[Any]] = {}  # lists with one entry per epoch

    def begin(self, name: str, streets: Streets | None, workspace: Array) -> None:
        """Start over with the prior in the workspace (size,)."""
        anchors_m = workspace[self._rows["anchors"]].reshape(-1, 3).copy()
        self._scenery = Scenery(name, anchors_m, streets)
        self._epochs = {key: [] for key in (*self._rows, "time_s", "mode")}
        self._append(workspace, 0.0, NO_MODE)
        self._epochs["nees"][0] = np.array([np.nan])  # replaces the previous episode's NEES

    def add(self, workspace: Array, mode: int) -> None:
        """Record the epoch that a mode just processed."""
        last = {key: values[-1] for key, values in self._epochs.items()}
        self._append(workspace, last["time_s"] + last["dt"][0], mode)

    def _append(self, workspace: Array, time_s: float, mode: int) -> None:
        numbers = {key: workspace[rows].copy() for key, rows in self._rows.items()}
        for key, value in {**numbers, "time_s": time_s, "mode": mode}.items():
            self._epochs[key].append(value)

    @property
    def history(self) -> History:
        """Return all epochs so far."""
        part = {key: np.array(values) for key, values in self._epochs.items()}
        states = part["truth"], part["estimate"], part["P"], part["nees"][:, 0]
        gates = part["accepted"] > 0.5, part["rejected"] > 0.5
        return History(self._scenery, self._axes, part["time_s"], part["mode"], *states, *gates)
