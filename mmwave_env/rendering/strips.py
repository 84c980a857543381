"""Strips below the map: speed, error, NEES and modes over time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mmwave_env.metrics import nees_interval
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.canvas import Canvas, Rect
from mmwave_env.rendering.history import History
from mmwave_env.rendering.street_map import draw_by_mode, nice, runs
from mmwave_env.rendering.theme import Theme

_WINDOW = 120  # number of epochs shown
_NEES = (0.03, 300.0)  # range shown; other values are at the edge
_WORDS_SHARE = 0.235  # share of the width left of the strips
_TICKS_SHARE = 0.06  # share of the width right of the strips
_ROW = 13.0  # height of a line of words, in units


@dataclass(frozen=True)
class Strip:
    """A quantity over n epochs, as it is drawn."""

    title: str  # title with the unit
    curve: Array  # (n,) values of the estimate, in the colors of the modes
    values: tuple[float, float]  # values at the lower and upper edge of the strip
    truth: Array | None = None  # (n,) true values; or None
    # lower and upper edge, (n,) or numbers, and the label; or None
    band: tuple[Array | float, Array | float, str] | None = None
    # values labelled on a logarithmic scale; without ticks, the scale is linear
    ticks: tuple[float, ...] = ()

    def heights(self, values: Array | float) -> Array:
        """Return the heights of values, from 0 at the lower edge to 1; others are clipped."""
        low, high = self.values
        shown = np.fmax(np.fmin(values, high), low)  # NaN is drawn as the worst value
        if self.ticks:
            low, high, shown = math.log(low), math.log(high), np.log(shown)
        return np.asarray((shown - low) / (high - low))


def draw_strips(
    canvas: Canvas, place: Rect, history: History, theme: Theme, beside: Sequence[History] = ()
) -> None:
    """Draw all strips in a part of the picture, with scales for the histories ``beside``, too."""
    unit, rows = canvas.unit, slice(max(1, history.epochs - _WINDOW + 1), None)
    words, ticks = _WORDS_SHARE * place.width, _TICKS_SHARE * place.width
    ribbon = 12.0 * unit
    height = (place.height - ribbon - 15.0 * unit) / 3.0
    lane = Rect(place.left + words, place.top, place.width - words - ticks, height)
    first, last = _times(history, rows)
    x = lane.left + (history.time_s[rows] - first) / (last - first) * lane.width
    modes = history.modes[rows]
    for i, make in enumerate((_speed, _error, _nees)):
        strips = [make(drawn, rows) for drawn in (history, *beside)]
        low, _ = strips[0].values
        strip = replace(strips[0], values=(low, max(strip.values[1] for strip in strips)))
        top = place.top + i * height + 2.0 * unit
        plot = Rect(lane.left, top, lane.width, height - 4.0 * unit)
        _draw_strip(canvas, place, plot, strip, x, modes, theme)
    lane = Rect(lane.left, place.top + 3.0 * height + 1.0, lane.width, ribbon)
    _draw_ribbon(canvas, place, lane, x, modes, theme)
    _draw_clock(canvas, lane, (first, last), theme)


def _times(history: History, rows: slice) -> tuple[float, float]:
    """Return the times at the left and right edge of a window that moves on when it is full."""
    time_s = history.time_s[rows]
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    first = float(time_s[0]) if len(time_s) else 0.0
    return first, float(max([first + (_WINDOW - 1) * step, *time_s[-1:]]))


def _speed(history: History, rows: slice) -> Strip:
    true, estimated = (speed[rows] for speed in history.speed_mps)
    most = 2.0 * float(true.max(initial=1.0))  # an estimate far beyond is shown at the edge
    top = _top(np.maximum(true, np.fmin(estimated, most)))
    return Strip("speed, m/s", estimated, (0.0, top), true)


def _error(history: History, rows: slice) -> Strip:
    error, expected = history.error_m[rows], history.error_95_m[rows]
    top = max(_top(error), _top(np.sort(expected)[: max(1, len(expected) // 2)]))
    band = (0.0, expected, "95 % band")
    return Strip("error, m", error, (0.0, top), band=band)


def _nees(history: History, rows: slice) -> Strip:
    band = (*nees_interval(history.axes), f"95 % of χ²({history.axes})")
    return Strip("NEES", history.nees[rows], _NEES, band=band, ticks=(0.1, 3.0, 100.0))


def _top(values: Array) -> float:
    """Return an upper edge above values (n,): a round value of at least 2."""
    known = values[np.isfinite(values)]
    largest = max(2.0, 1.05 * float(known.max(initial=0.0)))
    below = nice(largest)
    return next(step * below for step in (1.0, 2.0, 2.5) if step * below >= largest)


def _draw_strip(
    canvas: Canvas, place: Rect, plot: Rect, strip: Strip, x: Array, modes: Index, theme: Theme
) -> None:
    """Draw the frame, ticks, band and lines of a strip, and their key left of them."""
    unit = canvas.unit

    def y(values: Array | float) -> Array:
        return plot.bottom - strip.heights(values) * plot.height

    canvas.fill(theme.ground, plot)
    color = theme.mode(int(modes[-1])) if len(modes) else theme.quiet
    keys = [] if strip.truth is None else [("true", theme.truth, 1.6)]
    keys.append(("estimate", color, 2.4))
    if strip.band:
        low, high, meaning = strip.band
        keys.append((meaning, theme.band, 9.0))
        if len(x) > 1 or not isinstance(high, np.ndarray):
            edges = np.array([plot.left, plot.right]) if np.ndim(high) == 0 else x
            lower, upper = (np.broadcast_to(y(edge), edges.shape) for edge in (low, high))
            outline = np.stack([np.r_[edges, edges[::-1]], np.r_[lower, upper[::-1]]], axis=1)
            canvas.polygon(outline, theme.band)
    for tick in strip.ticks or strip.values:
        level = float(y(tick))
        canvas.line(np.array([[plot.left, level], [plot.right, level]]), theme.grid, 0.6)
        inside = min(max(level, plot.top + 5.0 * unit), plot.bottom - 5.0 * unit)
        canvas.words(f"{tick:g}", (plot.right + 4.0 * unit, inside), theme.quiet, 13)
    if len(x) > 1:
        if strip.truth is not None:
            canvas.line(np.stack([x, y(strip.truth)], axis=1), theme.truth, 1.4)
        draw_by_mode(canvas, np.stack([x, y(strip.curve)], axis=1), modes, theme, 1.8)
    left, row = place.left + 8.0 * unit, min(_ROW * unit, plot.height / (len(keys) + 1))
    canvas.words(strip.title, (left, plot.top + row / 2.0), theme.ink, 15)
    for i, (meaning, color, width) in enumerate(keys, start=1):
        level = plot.top + (i + 0.5) * row
        canvas.line(np.array([[left, level], [left + 14.0 * unit, level]]), color, width)
        canvas.words(meaning, (left + 19.0 * unit, level), theme.quiet, 13)


def _draw_ribbon(
    canvas: Canvas, place: Rect, lane: Rect, x: Array, modes: Index, theme: Theme
) -> None:
    """Draw the mode that ran in each epoch, with its number where there is room."""
    unit = canvas.unit
    canvas.words("mode", (place.left + 8.0 * unit, lane.centery), theme.ink, 15)
    canvas.fill(theme.ground, lane)
    if len(x) == 0:
        return
    ends = np.r_[x, 2.0 * x[-1] - x[-2] if len(x) > 1 else x[-1] + lane.width / _WINDOW]
    for begin, end in runs(modes):
        left, right = float(ends[begin]), min(float(ends[end]), lane.right)
        part = Rect(left, lane.top, right - left, lane.height)
        color = theme.mode(int(modes[begin]))
        canvas.fill(color, part)
        if part.width > 12.0 * unit:
            light = np.dot(color, (0.299, 0.587, 0.114)) > 140.0
            ink = (0, 0, 0) if light else (255, 255, 255)  # whichever contrasts more
            canvas.words(str(modes[begin]), part.center, ink, 13, 0.5)


def _draw_clock(canvas: Canvas, lane: Rect, times_s: tuple[float, float], theme: Theme) -> None:
    """Draw the time axis below the ribbon."""
    first, last = times_s
    step = nice((last - first) / 4.0)
    y = lane.bottom
    for time in np.arange(math.ceil(first / step), last / step + 1e-9) * step:
        x = lane.left + (time - first) / (last - first) * lane.width
        canvas.line(np.array([[x, y], [x, y + 3.0 * canvas.unit]]), theme.quiet, 0.8)
        canvas.words(f"{time:g} s", (x, y + 9.0 * canvas.unit), theme.quiet, 13, 0.5)
