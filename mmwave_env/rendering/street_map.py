"""Map with streets, walls, anchors and links, and the trajectories of user and estimate.

The visible part of the map follows the user.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mmwave_env.models.scene import Scene, Streets
from mmwave_env.numerics.ellipses import ellipse
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.canvas import Canvas, Point, Rect
from mmwave_env.rendering.history import History
from mmwave_env.rendering.theme import Paint

# length of moving averages, and time constant of their weights
_MEMORY_S = 20.0
_LAG_S = 4.0
_AHEAD_S = 4.0  # the upper edge is at least as far from the center as a user moves in this time
_LEAST_M = 25.0  # minimum distance from the center to the upper edge
_INNER = 0.8  # the estimate stays within this central fraction of the map's height
_STREET_M = 14.0  # width of streets in the picture, if blocks leave enough room
_PATH_M = 4.0  # width of the paths on which pedestrians cross blocks
LINKS = {"accepted": 1.2, "rejected": 1.6, "missing": 1.0}  # widths of the lines of links
_TRAIL = 1500  # maximum number of epochs of a trajectory that are drawn


class View(NamedTuple):
    """The visible part of the map, and the part of the picture in which it is drawn."""

    center_m: Array  # (2,) position on the map that is at the center
    scale: float  # units of the picture per meter
    frame: Rect  # part of the picture

    def pixels(self, points_m: Array) -> Array:
        """Convert points (n, 2 or more) of the map into positions (n, 2) in the picture."""
        offset = (points_m[:, :2] - self.center_m) * self.scale
        return self.frame.center + offset * (1.0, -1.0)


def follow(history: History, frame: Rect) -> View:
    """Return the view of the last epoch.

    The view depends only on the arguments, so a copy of an environment draws the same pictures. The
    user is at the center. The scale is an average over the last seconds, so that it changes
    smoothly; it changes faster only if the estimate would otherwise leave the map.
    """
    begin = np.searchsorted(history.time_s, history.time_s[-1] - _MEMORY_S)
    recent = history.part(slice(begin, None))
    weights = np.exp((recent.time_s - recent.time_s[-1]) / _LAG_S)
    truth = recent.truth[:, :2]
    gap = abs(recent.estimate[:, :2] - truth).max(axis=1)
    gap = np.where(np.isfinite(gap), gap, 0.0)
    wanted = np.maximum(np.maximum(_AHEAD_S * recent.true_mps, 1.2 * gap), _LEAST_M)
    half = max(np.average(wanted, weights=weights), gap[-1] / _INNER)
    return View(truth[-1], frame.height / (2.0 * half), frame)


def nice(value: float) -> float:
    """Return the largest number of the series ..., 1, 2, 5, 10, ... that is at most the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (10.0, 5.0, 2.0, 1.0) if step * power <= value * 1.000001)


def draw_map(canvas: Canvas, view: View, history: History) -> None:
    """Draw the complete map in the frame of the view."""
    canvas.clip(view.frame)
    canvas.fill("ground", view.frame)
    if history.scene:
        _draw_streets(canvas, view, history.scene.streets, history.truth[-_TRAIL:])
        _draw_walls(canvas, view, history.scene)
    _draw_links(canvas, view, history)
    _draw_tracks(canvas, view, history)
    _draw_anchors(canvas, view, history)
    canvas.clip(None)


def _draw_streets(canvas: Canvas, view: View, streets: Streets, truth: Array) -> None:
    """Draw houses, and between them streets and the path of the user, with assumed widths."""
    half = min(_STREET_M, streets.block_m / 4.0) / 2.0
    extents = streets.x_m, streets.y_m
    corners = np.transpose(extents) + [[-half], [half]]
    (left, bottom), (right, top) = view.pixels(corners)
    canvas.fill("building", Rect(left, top, right - left, bottom - top))
    for axis, (first, last) in enumerate(extents):
        for place in np.arange(first, last + half, streets.block_m):
            ends = corners.copy()
            ends[:, axis] = place
            canvas.line(view.pixels(ends), "street", 2.0 * half * view.scale)
    if len(truth) > 1:
        canvas.line(view.pixels(truth), "street", _PATH_M * view.scale)


def _draw_walls(canvas: Canvas, view: View, scene: Scene) -> None:
    """Draw the vertical walls of a scene."""
    reach = 2.0 * float(np.hypot(view.frame.width, view.frame.height)) / view.scale
    for wall in scene.walls:
        normal = np.array(wall.unit_normal)
        foot = view.center_m - wall.signed_distance(view.center_m) * normal
        along = reach * np.array([-normal[1], normal[0]])
        canvas.line(view.pixels(np.array([foot - along, foot + along])), "wall", 3.0)


def _draw_links(canvas: Canvas, view: View, history: History) -> None:
    """Draw each link, a line from the user to an anchor, as accepted, rejected or missing."""
    if history.epochs == 0:
        return
    (user,) = view.pixels(history.truth[-1:]).tolist()
    anchors = view.pixels(history.anchors_m).tolist()
    for anchor, fate in zip(anchors, history.fates[-1].tolist(), strict=False):
        ends = view.frame.clipline(user, anchor)
        if ends:
            draw_link(canvas, *ends, fate)


def draw_link(canvas: Canvas, start: Point, end: Point, fate: str) -> None:
    """Draw a link that was "accepted" (solid), "rejected" (dashed) or "missing" (faint)."""
    if fate == "rejected":
        canvas.dashes(start, end, fate, LINKS[fate])
    else:
        canvas.line([start, end], fate, LINKS[fate])


def _draw_tracks(canvas: Canvas, view: View, history: History) -> None:
    """Draw the trajectories and current positions of user and estimate, and the 2σ ellipse."""
    rows = slice(-_TRAIL, None)
    truth = view.pixels(history.truth[rows])
    track = view.pixels(history.estimate[rows])
    color = history.modes[-1]
    P = history.P[-1]
    if np.isfinite(P).all():
        outline = view.pixels(ellipse(history.estimate[-1, :2], P, 2.0, 48))
        canvas.line(outline, color, 1.2, closed=True)
    if len(truth) > 1:
        canvas.line(truth, "truth", 1.4)
        draw_by_mode(canvas, track, history.modes[rows], 2.2)
    canvas.disc(truth[-1], 4.0, "truth")
    draw_estimate(canvas, track[-1], color)


def draw_estimate(canvas: Canvas, at: Point | Array, color: Paint) -> None:
    """Draw the symbol of the estimate."""
    for radius, filled in ((5.0, "paper"), (4.0, color), (2.0, "paper")):
        canvas.disc(at, radius, filled)


def draw_by_mode(canvas: Canvas, points: Array, modes: Index, width: float) -> None:
    """Draw a line through points (n, 2); each piece has the color of the mode at its end."""
    for begin, end in runs(modes[1:]):
        canvas.line(points[begin : end + 1], modes[begin + 1], width)


def runs(modes: Index) -> list[tuple[int, int]]:
    """Return (first index, last index + 1) of each run of epochs with the same mode."""
    changes = np.flatnonzero(np.diff(modes)) + 1
    return list(pairwise([0, *changes.tolist(), len(modes)]))


def _draw_scale(canvas: Canvas, view: View) -> Rect:
    """Draw a scale bar in the lower right corner; return the part of the picture it covers."""
    length = nice(110.0 / view.scale)
    place = Rect(0.0, 0.0, length * view.scale + 12.0, 25.0)
    place.bottomright = view.frame.right - 4.0, view.frame.bottom - 2.0
    canvas.fill("paper", place)
    canvas.fill("ink", Rect(place.left + 6.0, place.bottom - 6.0, length * view.scale, 1.5))
    canvas.words(f"{length:g} m", (place.centerx, place.bottom - 15.0), "ink", align=0.5)
    return place


def _draw_anchors(canvas: Canvas, view: View, history: History) -> None:
    """Draw scale bar and anchors; those out of view at the edge, with their distance."""
    inner = view.frame.inflate(-14.0, -14.0)
    here = history.truth[-1, :3]
    beliefs = np.stack([here, history.estimate[-1, :3]])
    user, estimate = view.pixels(beliefs).tolist()
    around = 9.0
    names = []
    places = view.pixels(history.anchors_m).tolist()
    for number, (anchor, place) in enumerate(zip(history.anchors_m, places, strict=True)):
        name = f"anchor {number + 1}" if number else "gNB"
        at = place
        if not inner.collidepoint(place):
            _, at = inner.clipline(user, place) or (user, user)
            name += f", {np.linalg.norm(anchor - here):.0f} m"
        # the base station is a filled triangle; its mirror images are hollow triangles
        shape = np.add(at, [[0.0, -7.0], [6.0, 5.0], [-6.0, 5.0]])
        canvas.polygon(shape, "paper" if number else "ink")
        canvas.line(shape, "wall" if number else "ink", 1.5, closed=True)
        names.append((name, at))
    symbols = [user, estimate, *(at for _, at in names)]
    taken = [Rect(x - around, y - around, 2.0 * around, 2.0 * around) for x, y in symbols]
    taken.append(_draw_scale(canvas, view))
    for name, at in names:
        _label(canvas, name, at, view.frame, taken)


def _label(canvas: Canvas, text: str, at: Point, frame: Rect, taken: list[Rect]) -> None:
    """Draw a name near a point, inside the frame and, if possible, beside the ``taken`` parts."""
    width = canvas.width_of(text) + 6.0
    height = 15.0
    gap = 10.0
    places = [
        Rect(left, at[1] + (row - 0.5) * height, width, height).clamp(frame)
        for row in (0, 1, -1, 2, -2)
        for left in (at[0] + gap, at[0] - gap - width)
    ]
    place = next((place for place in places if place.collidelist(taken) < 0), places[0])
    taken.append(place)
    canvas.fill("paper", place)
    canvas.words(text, (place.left + 3.0, place.centery), "ink")
