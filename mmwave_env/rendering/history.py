"""History of an episode: the epochs so far, from which a picture is drawn."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
        return _lengths(self.estimate[:, :3] - self.truth[:, :3])

    @property
    def true_mps(self) -> Array:
        """Return the true speed (k + 1,), m/s."""
        return _lengths(self.truth[:, 3:])

    @property
    def speed_mps(self) -> Array:
        """Return the estimated speed (k + 1,), m/s."""
        return _lengths(self.estimate[:, 3:6])

    @property
    def fates(self) -> NDArray[np.str_]:
        """Return whether groups (k + 1, groups) were "accepted", "rejected" or "missing"."""
        return np.select([self.accepted, self.rejected], ["accepted", "rejected"], "missing")

    def part(self, rows: slice) -> "History":
        """Return a history with only these rows."""
        arrays: Any = self[4:]
        return History(*self[:4], *(array[rows] for array in arrays))


def _lengths(vectors: Array) -> Array:
    """Return the lengths (n,) of vectors (n, 3); those of a lost track may be arbitrarily large."""
    with np.errstate(over="ignore"):
        return np.linalg.norm(vectors, axis=1)  # type: ignore[no-any-return]
