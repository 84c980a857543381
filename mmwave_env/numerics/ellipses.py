"""Error ellipses, from packed covariances P (..., 3 or more) of x, y and maybe more."""

import numpy as np

from mmwave_env.numerics.numbers import Array


def axes_of(P: Array) -> tuple[Array, Array, Array]:
    """Return the half axes a >= b (...,), m, and the angle (...,), rad, from the x axis to a."""
    xx = P[..., 0]
    xy = P[..., 1]
    yy = P[..., 2]
    middle = 0.5 * (xx + yy)
    half = np.hypot(0.5 * (xx - yy), xy)
    minor = np.sqrt(np.maximum(middle - half, 0.0))
    return np.sqrt(middle + half), minor, 0.5 * np.arctan2(2.0 * xy, xx - yy)


def ellipse(center: Array, P: Array, deviations: float, corners: int) -> Array:
    """Return polygons (..., corners, 2), counterclockwise, about centers (..., 2).

    They are at ``deviations`` times the standard deviations.
    """
    major, minor, turn = axes_of(P)
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])  # (2, corners)
    c = np.cos(turn)
    s = np.sin(turn)
    axes = np.stack([c * major, s * major, -s * minor, c * minor], axis=-1)
    offsets = circle.T @ axes.reshape(*c.shape, 2, 2)
    return center[..., None, :] + deviations * offsets  # type: ignore[no-any-return]
