"""Users of a grid in place of a way: which stand for it, and how far off it they are."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.numerics.arrays import Array

_NEIGHBORS = 4  # users around a point of the way: the corners of its cell
_FLAT = 1e-3  # users whose spread across their line is less than this share of it are on a line
_AT_M = 1e-6  # who is as near as this stands for the point alone


class Sampling(NamedTuple):
    """Users that stand for the E epochs of a way.

    Attributes:
        users: (E, k) their numbers, the nearest first.
        weights: (E, k) of each; they add up to 1.
        position_m: (E, 3) where that is: the weighted mean of their positions.
        nearest_m: (E,) from the way to the nearest user.
    """

    users: NDArray[np.int_]
    weights: Array
    position_m: Array
    nearest_m: Array


def nearest_users(users_m: Array, way_m: Array) -> Sampling:
    """The nearest user (of N, 3) at every epoch of a way (E, 3)."""
    return _sampling(users_m, way_m, 1)


def surrounding_users(users_m: Array, way_m: Array) -> Sampling:
    """The four nearest users (of N, 3) at every epoch of a way (E, 3).

    With their weights, what is linear in x and y is exact at the way. On a line of users it is
    so at the way's nearest point of the line. Heights are not aimed at: users stand on the ground.
    """
    return _sampling(users_m, way_m, min(_NEIGHBORS, len(users_m)))


def _sampling(users_m: Array, way_m: Array, count: int) -> Sampling:
    from scipy.spatial import cKDTree

    distance, users = cKDTree(users_m).query(way_m, k=np.arange(1, count + 1))
    around = users_m[users]
    weights = _weights(around[..., :2], way_m[:, :2], distance)
    position = np.sum(weights[..., None] * around, axis=1)
    return Sampling(users, weights, position, distance[:, 0])


def _weights(around: Array, point: Array, distance: Array) -> Array:
    """Weights (E, k) that add up to 1 and make users around (E, k, 2) the point (E, 2).

    Near users count more: b_i ~ 1 / d_i^2 first, then the smallest change of them, in that
    measure, which moves their mean to the point (moving least squares).
    """
    b = 1.0 / (distance**2 + _AT_M**2)
    b /= b.sum(axis=1, keepdims=True)
    mean = np.sum(b[..., None] * around, axis=1)
    root = np.sqrt(b)
    spread = (around - mean[:, None]) * root[..., None]
    step = np.linalg.pinv(np.swapaxes(spread, 1, 2), rcond=_FLAT) @ (point - mean)[..., None]
    return np.asarray(b + root * step[..., 0])
