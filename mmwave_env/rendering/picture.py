"""Picture of an episode: a map above strips (diagrams over time) and a legend; needs pygame.

The strips show speed, error and NEES; a ribbon below them shows the mode of each epoch.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.metrics import nees_interval
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.canvas import UNITS, Canvas, Rect
from mmwave_env.rendering.history import History
from mmwave_env.rendering.street_map import (
    LINKS,
    draw_by_mode,
    draw_estimate,
    draw_link,
    draw_map,
    follow,
    nice,
    runs,
)
from mmwave_env.rendering.theme import SMALLEST, THEMES, Pixels

# maximum numbers of columns and rows in the legend of modes
_COLUMNS = 4
_ROWS = 3
_PAD = 8.0  # space to the left and right of words, units


def draw_picture(
    history: History,
    modes: Sequence[str],
    size: int = SMALLEST,
    theme: str = "light",
    title: str = "",
    beside: Sequence[History] = (),
    entries: int = 0,
) -> Pixels:
    """Draw a history's last epoch and the trajectory so far; return pixels (size, size, 3).

    The picture depends only on the arguments: the same history gives the same picture.

    Args:
        history: the history.
        modes: names of the actions, which the legend shows.
        size: height and width, px.
        theme: "light" or "dark".
        title: title, which may be empty.
        beside: histories of the same episode whose pictures are shown next to this one; the scales
            of speed and error fit all histories.
        entries: number of modes for which the legend has room at least.
    """
    canvas = Canvas(size, THEMES[theme].for_modes(modes))
    headline = 24.0 if title else 0.0
    canvas.words(title, (_PAD, 14.0), "ink", 22, room=UNITS - 2.0 * _PAD)
    _draw_header(canvas, history, headline + 10.0)
    top = headline + 20.0
    rows = min(_ROWS, -(-max(entries, len(modes)) // _COLUMNS))
    legend = UNITS - 15.0 * rows - 4.0
    strips = legend - 160.0
    frame = Rect(0.0, top, UNITS, strips - 17.0 - top)
    draw_map(canvas, follow(history, frame), history)
    _draw_legend(canvas, history, strips - 8.5)
    draw_strips(canvas, strips, history, beside)
    _draw_modes(canvas, history, modes, legend)
    return canvas.finish()


def _draw_header(canvas: Canvas, history: History, y: float) -> None:
    """Draw the episode's name and the epoch's values in one line."""
    error = f"error {history.error_m[-1]:.2f} m"
    if history.epochs == 0:
        numbers = f"prior   {error}"
    else:
        links = len(history.anchors_m)
        numbers = (
            f"epoch {history.epochs}   {history.time_s[-1]:g} s   "
            f"true {history.true_mps[-1]:.1f} m/s   "
            f"{error}   NEES {history.nees[-1]:.3g}   "
            f"links {history.accepted[-1, :links].sum()} of {links}"
        )
    room = UNITS - 3.0 * _PAD - canvas.width_of(numbers, 15)
    canvas.words(history.name, (_PAD, y), "ink", 15, room=room)
    canvas.words(numbers, (UNITS - _PAD, y), "ink", 15, align=1.0)


def _draw_legend(canvas: Canvas, history: History, y: float) -> None:
    """Draw the legend of the map's symbols and lines."""
    x = 12.0
    canvas.disc((x, y), 4.0, "truth")
    x = canvas.words("user", (x + 8.0, y), "quiet") + 16.0
    draw_estimate(canvas, (x, y), history.modes[-1])
    x = canvas.words("estimate, 2σ", (x + 8.0, y), "quiet") + 16.0
    canvas.words("links:", (x, y), "quiet")
    x += canvas.width_of("links: ")
    for fate in LINKS:
        draw_link(canvas, (x, y), (x + 22.0, y), fate)
        x = canvas.words(fate, (x + 26.0, y), "quiet") + 12.0


def _draw_modes(canvas: Canvas, history: History, modes: Sequence[str], top: float) -> None:
    """Draw the legend of modes, with the name of the current mode highlighted."""
    columns = min(_COLUMNS, len(modes))
    width = (UNITS - 2.0 * _PAD) / columns
    for mode, name in enumerate(modes[: _COLUMNS * _ROWS]):
        left = _PAD + mode % columns * width
        y = top + mode // columns * 15.0 + 8.0
        canvas.fill(mode, Rect(left, y - 5.0, 14.0, 10.0))
        paint = "ink" if history.modes[-1] == mode else "quiet"
        canvas.words(f"{mode} {name}", (left + 19.0, y), paint, room=width - 24.0)


_GAP_SHARE = 1 / 120  # gap between two pictures, as a share of a picture's width


@dataclass
class Playback:
    """A painter of several histories of an episode, side by side at the same epoch.

    Each history has its own ``modes`` (names of actions) and its own title; ``size`` is the height
    and width of a picture, px.
    """

    histories: Sequence[History]
    modes: Sequence[Sequence[str]]
    titles: Sequence[str]
    size: int
    theme: str

    def draw(self, epochs: int) -> Pixels:
        """Draw all histories after ``epochs`` epochs; return pixels (size, sum of widths, 3)."""
        known = [history.part(slice(epochs + 1)) for history in self.histories]
        entries = max(map(len, self.modes))  # to align the strips of pictures
        drawn = [
            draw_picture(history, modes, self.size, self.theme, title, known, entries)
            for history, modes, title in zip(known, self.modes, self.titles, strict=True)
        ]
        for picture in drawn[1:]:
            picture[:, : round(_GAP_SHARE * self.size)] = picture[0, 0]
        return np.concatenate(drawn, axis=1)


Ends = tuple[float, float]  # least and greatest value of a scale or an interval

_WINDOW = 120  # number of epochs that strips show
_NEES = (0.03, 300.0)  # range of the NEES strip; other values are drawn at its edges
_NEES_TICKS = (0.1, 3.0, 100.0)
# left edge and width of the strips; words are beside them
_LEFT = 112.8
_WIDTH = 338.4
# heights of a strip, of a gap and of the ribbon
_HEIGHT = 121.0 / 3.0
_GAP = 4.0
_RIBBON = 12.0


class Strip(NamedTuple):
    """A diagram of a quantity over n epochs; values beyond the ends are drawn at the edges."""

    title: str  # quantity and unit
    values: Array  # (n,) values of the estimate, drawn in the colors of the modes; NaN at the top
    ends: Ends  # values at the lower and at the upper edge
    ticks: tuple[float, ...]  # values that label the scale
    scale: Callable[[ArrayLike], Array] = np.asarray  # np.log for a logarithmic scale
    truth: Array | None = None  # (n,) true values, if known
    band: Ends | None = None  # ends of the interval of expected values


def draw_strips(canvas: Canvas, top: float, history: History, beside: Sequence[History]) -> None:
    """Draw all strips below ``top``, with scales that also fit the histories ``beside``."""
    rows = slice(max(1, history.epochs - _WINDOW + 1), None)
    shown = history.part(rows)
    modes = shown.modes
    times_s = _times(shown.time_s, float(history.time_s[-1]))
    x = _across(shown.time_s, times_s)
    for i, strip in enumerate(_strips(shown, [each.part(rows) for each in (history, *beside)])):
        plot = Rect(_LEFT, top + i * (_HEIGHT + _GAP) + _GAP / 2.0, _WIDTH, _HEIGHT)
        _draw_strip(canvas, plot, strip, x, modes)
    lane = Rect(_LEFT, top + 3.0 * (_HEIGHT + _GAP) + 1.0, _WIDTH, _RIBBON)
    _draw_ribbon(canvas, lane, x, modes)
    _draw_clock(canvas, lane.bottom, times_s)


def _across(time_s: Array, times_s: Ends) -> Array:
    """Return the horizontal positions of times in strips with these times at their edges."""
    return np.interp(time_s, times_s, (_LEFT, _LEFT + _WIDTH))


def _times(time_s: Array, latest: float) -> Ends:
    """Return the times at the left and right edge of strips with room for ``_WINDOW`` epochs."""
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    first = float(time_s[0]) if len(time_s) else latest
    return first, max(first + (_WINDOW - 1) * step, latest)


def _strips(history: History, together: Sequence[History]) -> list[Strip]:
    """Return the strips of a history, with scales that fit all histories."""
    true = history.true_mps
    most = 2.0 * float(true.max(initial=1.0))  # a larger estimate is drawn at the upper edge
    speeds = (0.0, _top([true, *(np.fmin(drawn.speed_mps, most) for drawn in together)]))
    errors = (0.0, _top([drawn.error_m for drawn in together]))
    band = nees_interval(history.axes)
    return [
        Strip("speed, m/s", history.speed_mps, speeds, speeds, truth=true),
        Strip("error, m", history.error_m, errors, errors),
        Strip("NEES, 95 % band", history.nees, _NEES, _NEES_TICKS, np.log, band=band),
    ]


def _top(values: Sequence[Array]) -> float:
    """Return a round number, >= 2 and above all finite values, for the upper edge of a strip."""
    known = np.concatenate(values)
    largest = max(2.0, 1.05 * float(known.max(initial=0.0, where=np.isfinite(known))))
    below = nice(largest)
    return next(step * below for step in (1.0, 2.0, 2.5) if step * below >= largest)


def _draw_strip(canvas: Canvas, plot: Rect, strip: Strip, x: Array, modes: Index) -> None:
    """Draw background, ticks, band and lines of a strip, and its title to the left."""

    def y(values: ArrayLike) -> Array:
        inside = np.clip(np.nan_to_num(values, nan=np.inf), *strip.ends)
        return np.interp(strip.scale(inside), strip.scale(strip.ends), (plot.bottom, plot.top))

    canvas.fill("ground", plot)
    canvas.words(strip.title, (_PAD, plot.centery), "ink", 15)
    if strip.band is not None:
        lower, upper = y(strip.band)
        canvas.fill("band", Rect(plot.left, upper, plot.width, lower - upper))
    for tick, level in zip(strip.ticks, y(strip.ticks), strict=True):
        canvas.line([[plot.left, level], [plot.right, level]], "grid", 0.6)
        inside = min(max(level, plot.top + 5.0), plot.bottom - 5.0)
        canvas.words(f"{tick:g}", (plot.right + 4.0, inside), "quiet", 13)
    if len(x) > 1:
        if strip.truth is not None:
            canvas.line(np.stack([x, y(strip.truth)], axis=1), "truth", 1.4)
        draw_by_mode(canvas, np.stack([x, y(strip.values)], axis=1), modes, 1.8)


def _draw_ribbon(canvas: Canvas, lane: Rect, x: Array, modes: Index) -> None:
    """Draw a ribbon in the colors of the modes that ran."""
    canvas.words("mode", (_PAD, lane.centery), "ink", 15)
    canvas.fill("ground", lane)
    if len(x) == 0:
        return
    ends = np.append(x, x[-1] + lane.width / _WINDOW)
    for begin, end in runs(modes):
        left = float(ends[begin])
        right = min(float(ends[end]), lane.right)
        canvas.fill(modes[begin], Rect(left, lane.top, right - left, lane.height))


def _draw_clock(canvas: Canvas, y: float, times_s: Ends) -> None:
    """Draw the time axis below the ribbon."""
    first, last = times_s
    step = nice((last - first) / 4.0)
    ticks = np.arange(math.ceil(first / step), last / step + 1e-9) * step
    for time, x in zip(ticks, _across(ticks, times_s), strict=True):
        canvas.line([[x, y], [x, y + 3.0]], "quiet", 0.8)
        canvas.words(f"{time:g} s", (x, y + 9.0), "quiet", 13, 0.5)
