"""Which paths bounced once, where the files do not say it: from their delay and two directions."""

import numpy as np

from mmwave_env.episodes.deepmimo.paths import TOLERANCE_M
from mmwave_env.numerics.arrays import Array, Mask

_SAME_WAY = np.cos(0.02)  # of an angle in rad, between a departure and the way to the bounce
_MOVES_M = 2.0 * TOLERANCE_M  # across all bounces that have an image in common


def single_bounces(
    station_m: Array, position_m: Array, range_m: Array, arrival: Array, departure: Array
) -> Array:
    """Where paths bounce (E, P, 3); NaN for those that are not one reflection in a flat wall.

    A path of length r that arrives at p along u seems to come from a = p - r u. If it bounced
    once, it did so where it is as far from a as from the station, and left for there. Scattering
    and diffraction at one point look alike, but that point stays where it is while its image
    moves. In a wall, the image stays and the bounce moves: only such images count.

    Args:
        station_m: (3,) the base station.
        position_m: (E, 3) the receivers.
        range_m: (E, P) lengths; NaN for paths that can't be reflections.
        arrival, departure: (E, P, 3) unit vectors along propagation.
    """
    image = position_m[:, None] - range_m[..., None] * arrival
    normal = station_m - image
    with np.errstate(all="ignore"):  # of a path that can't be one, infinities come out
        share = _dot(normal, normal) / (2.0 * range_m * _dot(normal, arrival))
        bounce = image + (share * range_m)[..., None] * arrival
        leaving = bounce - station_m
        agrees = _dot(leaving, departure) >= _SAME_WAY * np.linalg.norm(leaving, axis=-1)
    once = agrees & (share > 0.0) & (share < 1.0)
    once[once] = _are_walls(image[once], bounce[once])
    return np.where(once[..., None], bounce, np.nan)


def _are_walls(image: Array, bounce: Array) -> Mask:
    """Which of the images (n, 3) stay where they are while the bounces (n, 3) move."""
    from scipy.spatial import cKDTree

    found, done = np.zeros(len(image), bool), np.zeros(len(image), bool)
    tree = cKDTree(image) if len(image) else None
    for i in range(len(image)):
        if not done[i] and tree is not None:
            near = tree.query_ball_point(image[i], TOLERANCE_M)
            done[near] = True
            found[near] |= np.linalg.norm(np.ptp(bounce[near], axis=0)) > _MOVES_M
    return found


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))
