"""Camera: the visible part of the map, which follows user and estimate without jumps."""

import math
from typing import NamedTuple

import numpy as np

from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.canvas import Point, Rect
from mmwave_env.rendering.history import History

_MEMORY_S, _LAG_S = 20.0, 4.0  # length of the past that counts; time constant with which it fades
_AHEAD_S = 4.0  # time of the user's travel that fits between the center and the edge
_LEAST_M = 25.0  # least distance from the center to the upper edge
_INNER = 0.5  # share of the picture's height and width in which user and estimate stay


class View(NamedTuple):
    """A part of the map in a part of the picture.

    Attributes:
        center_m: (2,) position at the center.
        scale: px per meter.
        frame: the part of the picture.
    """

    center_m: Array
    scale: float
    frame: Rect

    def pixels(self, points_m: Array) -> Array:
        """Return the positions (n, 2) in the picture of points (n, 2 or more) of the map."""
        offset = (points_m[:, :2] - self.center_m) * self.scale
        return self.frame.center + offset * (1.0, -1.0)

    @property
    def extent_m(self) -> tuple[Array, Array]:
        """Return the south-west and north-east corners (2,) of the visible part."""
        half = np.array([self.frame.width, self.frame.height]) / (2.0 * self.scale)
        return self.center_m - half, self.center_m + half


def follow(history: History, frame: Rect) -> View:
    """Return the view of the last epoch: a function of the history, so that a copy shows the same.

    Center and scale are averages over the last seconds, so that they change smoothly, except where
    this would lose the user or the estimate.
    """
    recent = history.time_s >= history.time_s[-1] - _MEMORY_S
    weights = np.exp((history.time_s[recent] - history.time_s[-1]) / _LAG_S)
    weights /= weights.sum()
    user = history.truth[recent]
    truth, speed = user[:, :2], np.linalg.norm(user[:, 3:6], axis=1)
    estimate = np.where(
        np.isfinite(history.estimate[recent, :2]), history.estimate[recent, :2], truth
    )
    gap = abs(truth - estimate).max(axis=1)
    deviation = np.sqrt(np.maximum(np.nan_to_num(history.P[recent][:, [0, 2]]).max(axis=1), 0.0))
    wanted = np.maximum.reduce(
        [np.full(len(gap), _LEAST_M), _AHEAD_S * speed, 1.2 * gap, 3.0 * deviation]
    )
    shape = np.array([frame.width / frame.height, 1.0])
    half = max(
        float(weights @ wanted),
        float((abs(truth[-1] - estimate[-1]) / (2.0 * _INNER * shape)).max()) * 1.01,
    )
    center = weights @ ((truth + estimate) / 2.0)
    inner = _INNER * half * shape
    now = np.stack([truth[-1], estimate[-1]])
    center = np.clip(center, now.max(axis=0) - inner, now.min(axis=0) + inner)
    return View(center, frame.height / (2.0 * half), frame)


def clipped(start: Point, end: Point, frame: Rect) -> tuple[Point, Point] | None:
    """Clip a line to a frame (Liang and Barsky 1984); return None if it is outside."""
    begin, way = np.array(start), np.subtract(end, start)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (np.array([frame.topleft, frame.bottomright]) - begin) / way
    first = np.nanmax(shares.min(axis=0), initial=0.0)
    last = np.nanmin(shares.max(axis=0), initial=1.0)
    if not first <= last:
        return None
    return tuple((begin + np.outer((first, last), way)).tolist())


def nice(value: float) -> float:
    """Return the largest of ..., 1, 2, 5, 10, ... that is not above the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (10.0, 5.0, 2.0, 1.0) if step * power <= value * 1.000001)
