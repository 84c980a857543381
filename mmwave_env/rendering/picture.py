"""Picture of an episode: a map above strips (diagrams over time) and a legend; needs pygame.

The strips show speed, error and NEES; a ribbon below them shows the mode of each epoch.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.io.lookup import choose, printable
from mmwave_env.metrics import nees_interval
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.canvas import UNITS, Canvas, Rect
from mmwave_env.rendering.history import History
from mmwave_env.rendering.street_map import draw_by_mode, draw_map, follow, nice, runs
from mmwave_env.rendering.theme import SMALLEST, THEMES, Pixels

# maximum numbers of columns and rows in the legend of modes
_COLUMNS = 4
_ROWS = 3
_PAD = 8.0  # space to the left and right of words, units


def legend_rows(modes: int) -> int:
    """Return the number of rows, at most ``_ROWS``, in a legend of this number of modes."""
    return min(_ROWS, -(-modes // _COLUMNS))


class Picture:
    """Painter of the epochs of an episode.

    The picture is ``size`` px high and wide, with a ``title``, which may be empty. Its legend shows
    ``modes``, the names of the actions, and has room for at least ``rows`` rows.
    """

    def __init__(
        self,
        modes: Sequence[str],
        size: int = SMALLEST,
        theme: str = "light",
        title: str = "",
        rows: int = 0,
    ) -> None:
        self._canvas = Canvas(size, choose(THEMES, theme, "render_theme").for_modes(modes))
        self._modes = [f"{number} {printable(name)}" for number, name in enumerate(modes)]
        self._title = printable(title)
        self._rows = max(rows, legend_rows(len(modes)))

    def draw(self, history: History, beside: Sequence[History] = ()) -> Pixels:
        """Draw a history's last epoch and the trajectory so far; return pixels (size, size, 3).

        The picture depends only on the arguments: the same history gives the same picture. The
        histories ``beside`` belong to the same episode, and their pictures are shown next to this
        one; the scales of speed and error fit all histories.
        """
        canvas = self._canvas
        canvas.fill("paper")
        title = 24.0 if self._title else 0.0
        if self._title:
            words = canvas.fitting(self._title, UNITS - 2.0 * _PAD, 22)
            canvas.words(words, (_PAD, 14.0), "ink", 22)
        self._draw_header(history, title + 10.0)
        top = title + 20.0
        legend = UNITS - 15.0 * self._rows - 4.0
        strips = legend - 160.0
        frame = Rect(0.0, top, UNITS, strips - 17.0 - top)
        draw_map(canvas, follow(history, frame), history)
        self._draw_legend(history, strips - 8.5)
        draw_strips(canvas, strips, history, beside)
        self._draw_modes(history, legend)
        return canvas.finish()

    def _draw_header(self, history: History, y: float) -> None:
        """Draw the episode's name and the epoch's values in one line."""
        canvas = self._canvas
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
        room = UNITS - 3.0 * _PAD - canvas.width_of(numbers)
        name = canvas.fitting(printable(history.name), room)
        canvas.words(name, (_PAD, y), "ink")
        canvas.words(numbers, (UNITS - _PAD, y), "ink", align=1.0)

    def _draw_legend(self, history: History, y: float) -> None:
        """Draw the legend of the map's symbols and lines."""
        canvas = self._canvas
        x = 12.0
        canvas.disc((x, y), 4.0, "truth")
        x = canvas.words("user", (x + 8.0, y), "quiet", 14).right + 16.0
        canvas.disc((x, y), 4.0, history.modes[-1])
        canvas.disc((x, y), 2.0, "paper")
        x = canvas.words("estimate, 2σ", (x + 8.0, y), "quiet", 14).right
        canvas.words("links:", (x + 16.0, y), "quiet", 14)
        x += 16.0 + canvas.width_of("links: ", 14)
        for meaning in ("accepted", "rejected", "missing"):
            start = (x, y)
            end = (x + 22.0, y)
            if meaning == "rejected":
                canvas.dashes(start, end, meaning, 1.6)
            else:
                canvas.line([start, end], meaning, 1.4)
            x = canvas.words(meaning, (x + 26.0, y), "quiet", 14).right + 12.0

    def _draw_modes(self, history: History, top: float) -> None:
        """Draw the legend of modes, with the name of the current mode highlighted."""
        canvas = self._canvas
        columns = min(_COLUMNS, len(self._modes))
        width = (UNITS - 2.0 * _PAD) / columns
        shown = self._modes[: _COLUMNS * _ROWS]
        for mode, name in enumerate(shown):
            left = _PAD + mode % columns * width
            y = top + mode // columns * 15.0 + 8.0
            now = history.modes[-1] == mode
            canvas.fill(mode, Rect(left, y - 5.0, 14.0, 10.0))
            words = canvas.fitting(name, width - 24.0, 14)
            canvas.words(words, (left + 19.0, y), "ink" if now else "quiet", 14)


_GAP_SHARE = 1 / 120  # gap between two pictures, as a share of a picture's width


class Playback:
    """A painter of several histories of an episode, side by side at the same epoch.

    Each history has its own ``modes`` (names of actions) and its own title; see :class:`Picture`.
    """

    def __init__(
        self,
        histories: Sequence[History],
        modes: Sequence[Sequence[str]],
        titles: Sequence[str],
        size: int,
        theme: str,
    ) -> None:
        rows = max(legend_rows(len(names)) for names in modes)  # to align the strips of pictures
        pictures = [
            Picture(names, size, theme, title, rows)
            for names, title in zip(modes, titles, strict=True)
        ]
        self._parts = list(zip(histories, pictures, strict=True))

    def draw(self, epochs: int) -> Pixels:
        """Draw all histories after ``epochs`` epochs; return pixels (size, sum of widths, 3)."""
        known = [history.part(slice(epochs + 1)) for history, _ in self._parts]
        drawn = [
            picture.draw(history, known)
            for history, (_, picture) in zip(known, self._parts, strict=True)
        ]
        for picture in drawn[1:]:
            picture[:, : round(_GAP_SHARE * len(picture))] = picture[0, 0]
        return np.concatenate(drawn, axis=1)


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
    """A diagram of a quantity over n epochs; heights are 0 at its lower edge, 1 at its upper."""

    title: str  # quantity and unit
    curve: Array  # (n,) heights of the values of the estimate, drawn in the colors of the modes
    ticks: dict[float, Any]  # values that label the scale -> their heights
    truth: Array | None = None  # (n,) heights of the true values, if known
    band: Array | None = None  # (2,) heights of the ends of the interval of expected values


def draw_strips(canvas: Canvas, top: float, history: History, beside: Sequence[History]) -> None:
    """Draw all strips below ``top``, with scales that also fit the histories ``beside``."""
    rows = slice(max(1, history.epochs - _WINDOW + 1), None)
    modes = history.modes[rows]
    first, last = _times(history, rows)
    x = _LEFT + (history.time_s[rows] - first) / (last - first) * _WIDTH
    for i, strip in enumerate(_strips(history, rows, [history, *beside])):
        plot = Rect(_LEFT, top + i * (_HEIGHT + _GAP) + _GAP / 2.0, _WIDTH, _HEIGHT)
        _draw_strip(canvas, plot, strip, x, modes)
    lane = Rect(_LEFT, top + 3.0 * (_HEIGHT + _GAP) + 1.0, _WIDTH, _RIBBON)
    _draw_ribbon(canvas, lane, x, modes)
    _draw_clock(canvas, lane, (first, last))


def _times(history: History, rows: slice) -> tuple[float, float]:
    """Return the times at the left and right edge of strips with room for ``_WINDOW`` epochs."""
    time_s = history.time_s[rows]
    step = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    first = float(time_s[0]) if len(time_s) else 0.0
    return first, float(max([first + (_WINDOW - 1) * step, *time_s[-1:]]))


def _strips(history: History, rows: slice, together: Sequence[History]) -> list[Strip]:
    """Return the strips of some rows of a history, with scales that fit all histories."""
    true = history.true_mps[rows]
    most = 2.0 * float(true.max(initial=1.0))  # a larger estimate is drawn at the upper edge
    fastest = _top([true, *(np.fmin(drawn.speed_mps[rows], most) for drawn in together)])
    farthest = _top([drawn.error_m[rows] for drawn in together])
    axes = history.axes
    return [
        Strip(
            "speed, m/s", history.speed_mps[rows] / fastest, {0.0: 0.0, fastest: 1.0},
            truth=true / fastest,
        ),
        Strip("error, m", history.error_m[rows] / farthest, {0.0: 0.0, farthest: 1.0}),
        Strip(
            "NEES, 95 % band", _nees_height(history.nees[rows]),
            {tick: _nees_height(tick) for tick in _NEES_TICKS},
            band=_nees_height(nees_interval(axes)),
        ),
    ]  # fmt: skip


def _nees_height(nees: ArrayLike) -> Array:
    """Return the heights of NEES values in their strip, whose scale is logarithmic."""
    low, high = np.log(_NEES)
    return (np.log(np.maximum(nees, 1e-9)) - low) / (high - low)  # type: ignore[no-any-return]


def _top(values: Sequence[Array]) -> float:
    """Return a round number, >= 2 and above all finite values, for the upper edge of a strip."""
    known = np.concatenate(values)
    known = known[np.isfinite(known)]
    largest = max(2.0, 1.05 * float(known.max(initial=0.0)))
    below = nice(largest)
    return next(step * below for step in (1.0, 2.0, 2.5) if step * below >= largest)


def _draw_strip(canvas: Canvas, plot: Rect, strip: Strip, x: Array, modes: Index) -> None:
    """Draw background, ticks, band and lines of a strip, and its title to the left."""

    def y(heights: Any) -> Any:
        # np.clip would keep NaN, which is drawn at the upper edge
        return plot.bottom - np.fmax(np.fmin(heights, 1.0), 0.0) * plot.height

    canvas.fill("ground", plot)
    canvas.words(strip.title, (_PAD, plot.centery), "ink", 15)
    if strip.band is not None:
        lower, upper = y(strip.band)
        canvas.fill("band", Rect(plot.left, upper, plot.width, lower - upper))
    for tick, height in strip.ticks.items():
        level = float(y(height))
        canvas.line([[plot.left, level], [plot.right, level]], "grid", 0.6)
        inside = min(max(level, plot.top + 5.0), plot.bottom - 5.0)
        canvas.words(f"{tick:g}", (plot.right + 4.0, inside), "quiet", 13)
    if len(x) > 1:
        if strip.truth is not None:
            canvas.line(np.stack([x, y(strip.truth)], axis=1), "truth", 1.4)
        draw_by_mode(canvas, np.stack([x, y(strip.curve)], axis=1), modes, 1.8)


def _draw_ribbon(canvas: Canvas, lane: Rect, x: Array, modes: Index) -> None:
    """Draw a ribbon in the colors of the modes that ran, with the modes' numbers where they fit."""
    canvas.words("mode", (_PAD, lane.centery), "ink", 15)
    canvas.fill("ground", lane)
    if len(x) == 0:
        return
    ends = np.r_[x, 2.0 * x[-1] - x[-2] if len(x) > 1 else x[-1] + lane.width / _WINDOW]
    for begin, end in runs(modes):
        left = float(ends[begin])
        right = min(float(ends[end]), lane.right)
        part = Rect(left, lane.top, right - left, lane.height)
        canvas.fill(modes[begin], part)
        if part.width > 12.0:
            light = np.dot(canvas.color(modes[begin]), (0.299, 0.587, 0.114)) > 140.0
            ink = (0, 0, 0) if light else (255, 255, 255)  # the color that contrasts more
            canvas.words(str(modes[begin]), part.center, ink, 13, 0.5)


def _draw_clock(canvas: Canvas, lane: Rect, times_s: tuple[float, float]) -> None:
    """Draw the time axis below the ribbon."""
    first, last = times_s
    step = nice((last - first) / 4.0)
    y = lane.bottom
    for time in np.arange(math.ceil(first / step), last / step + 1e-9) * step:
        x = lane.left + (time - first) / (last - first) * lane.width
        canvas.line([[x, y], [x, y + 3.0]], "quiet", 0.8)
        canvas.words(f"{time:g} s", (x, y + 9.0), "quiet", 13, 0.5)
