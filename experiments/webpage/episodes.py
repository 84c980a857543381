"""Episodes to play on a page: what its script is given of each, in few digits."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from mmwave_env.metrics import nees_interval
from mmwave_env.models.measurement import Layout
from mmwave_env.models.scene import Streets
from mmwave_env.numerics.arrays import Array, Index, Mask
from mmwave_env.rendering.history import GATE

LONGEST = 600  # epochs that can be watched


class Place(NamedTuple):
    """Where an episode is, and what is measured there.

    Attributes:
        anchors_m: (L, 3) the base station first.
        streets: None where nobody knows them.
        layout: of the measurements.
        axes: position axes that NEES covers.
    """

    anchors_m: Array
    streets: Streets | None
    layout: Layout
    axes: int


class Gates(NamedTuple):
    """What became of measurements (T, groups): accepted or rejected, or neither; and their NIS."""

    accepted: Array | Mask
    rejected: Array | Mask
    nis: Array


def scenery(
    name: str, place: Place, time_s: Array, truth_m: Array, speed_mps: Array
) -> dict[str, Any]:
    """An episode without its contenders.

    Args:
        name: of the episode.
        place: where it is.
        time_s: (T,) of the epochs.
        truth_m: (T, 3) position, NaN where nobody knows it.
        speed_mps: (T,).
    """
    rows, groups = slice(LONGEST), place.layout.groups
    dof = [group.stop - group.start for group in groups]
    streets = place.streets and {
        "x": [*place.streets.x_m], "y": [*place.streets.y_m], "block": place.streets.block_m,
    }  # fmt: skip
    names = ["gNB", *place.layout.group_names[1:]]
    return {
        "name": name,
        "cut": max(0, len(time_s) - LONGEST),
        "time_s": rounded(time_s[rows] - time_s[0], 3),
        "x": rounded(truth_m[rows, 0]),
        "y": rounded(truth_m[rows, 1]),
        "speed_mps": rounded(speed_mps[rows]),
        "anchors": [rounded(one) for one in place.anchors_m],
        "streets": streets,
        "groups": names,
        "rows": dof,
        "limits": [float(chdtri(n, 1.0 - GATE)) for n in dof],
        "nees_bounds": [*nees_interval(place.axes)],
        "contenders": {},
    }


def course(
    x: Array,
    P: Array,
    error_m: Array,
    nees: Array,
    gates: Gates,
    modes: Sequence[str],
    mode: Index,
    weighed: bool,
) -> dict[str, Any]:
    """What a contender did in an episode.

    Args:
        x, P: (T, 7), (T, 28) its beliefs, covariances packed.
        error_m, nees: (T, 3), (T,) of these; NaN where nobody knows the truth.
        gates: of the mode that ran.
        modes: names of what it chooses from.
        mode: (T,) number of the one that ran.
        weighed: whether that is only the most probable one.
    """
    rows = slice(LONGEST)
    letters = np.where(gates.accepted > 0.5, "a", np.where(gates.rejected > 0.5, "r", "m"))
    return {
        "x": rounded(x[rows, 0]),
        "y": rounded(x[rows, 1]),
        "P": [numbers(P[rows, k], 4) for k in range(3)],  # xx, xy, yy
        "speed_mps": rounded(np.linalg.norm(x[rows, 3:6], axis=1)),
        "error_m": rounded(np.linalg.norm(error_m[rows], axis=1)),
        "nees": numbers(nees[rows], 4),
        "modes": list(modes),
        "mode": mode[rows].tolist(),
        "weighed": weighed,
        "fate": ["".join(column) for column in letters[rows].T],
        "nis": [numbers(group, 4) for group in gates.nis[rows].T],
    }


def numbers(values: Array, digits: int = 5) -> list[float | None]:
    """Rounded to so many digits; null where there is no number."""
    return [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in values]


def rounded(values: Array, decimals: int = 2) -> list[float | None]:
    """Rounded to so many decimals; null where there is no number."""
    return [round(float(v), decimals) if np.isfinite(v) else None for v in values]
