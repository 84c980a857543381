"""Which path belongs to which anchor: global nearest neighbor in NIS, gated.

Global nearest neighbor is the one assignment of paths to anchors, each once at most, with the
least sum of NIS, where an anchor without a path costs as much as the gate (Blackman and Popoli
1999, Sec. 6.4). The NIS is that of the filters, seen along the tangent (EKF) at the prediction.
"""

import numpy as np
from scipy.optimize import linear_sum_assignment

from mmwave_env.filters.gating import innovation_statistics
from mmwave_env.filters.linearization import Tangent
from mmwave_env.models.measurement import link_group
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.numerics.linalg import cholesky
from mmwave_env.numerics.numbers import Matrix, Vector

NO_PATH = -1


def path_nis(x: Vector, P: Matrix, anchors: Matrix, paths: Array, sigma: Array) -> Array:
    """NIS (L, n) of every path as a link of every anchor.

    Args:
        x, P: (7,), (7, 7) predicted belief.
        anchors: (L, 3) positions, m.
        paths, sigma: (L, n, 4) rows of a link, m and rad, as each anchor would have measured the
            path, and their standard deviations.
    """
    tangent, L = Tangent(), cholesky(P)
    latents, nis = tangent.latents(0), np.empty(paths.shape[:2])
    for row, anchor, z, deviations in zip(nis, anchors, paths, sigma, strict=True):
        group = link_group(x, anchor, list(z.T), list(np.square(deviations).T))
        row[:], _ = innovation_statistics(group, tangent.rows(group, L, latents), latents)
    return nis


def assign(nis: Array, gate: float) -> Index:
    """The path of every anchor (L,), ``NO_PATH`` where none is within the gate.

    Args:
        nis: (L, n) as :func:`path_nis` gives it.
        gate: the largest NIS of a path that belongs to an anchor.
    """
    found = np.full(len(nis), NO_PATH)
    # A pair outside the gate costs as much as the gate, and means that neither has a partner.
    anchors, paths = linear_sum_assignment(np.minimum(np.nan_to_num(nis, nan=np.inf), gate))
    inside = nis[anchors, paths] < gate
    found[anchors[inside]] = paths[inside]
    return found


def disagreement(paths: Array, sigma: Array) -> Array:
    """How far arrival and departure of paths (n, 4) contradict each other: NIS, 1 degree (n,).

    Both are looks at one bearing, so this needs no belief (paper, Sec. II-B).
    """
    group = link_group([1.0] * 7, [0.0] * 3, list(paths.T), list(np.square(sigma).T))
    return np.asarray(group.spare_nis)
