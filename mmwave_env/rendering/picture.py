"""Picture of an episode from above, with the state of the filter; needs pygame."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mmwave_env.io.lookup import choose, printable
from mmwave_env.rendering.canvas import Canvas, Rect
from mmwave_env.rendering.history import History
from mmwave_env.rendering.street_map import draw_map, follow
from mmwave_env.rendering.strips import draw_strips
from mmwave_env.rendering.theme import SMALLEST, THEMES

_COLUMNS, _ROWS = 4, 3  # most columns and rows of the legend of modes


def legend_rows(modes: int) -> int:
    """Return the number of rows of a legend of so many modes, as far as it is shown."""
    return min(_ROWS, -(-modes // _COLUMNS))


class Picture:
    """Painter of the epochs of an episode.

    Args:
        modes: names of the actions.
        size: height and width in px.
        theme: "light" or "dark".
        title: title above the picture; empty for none.
        rows: least number of rows of the legend of modes.
    """

    def __init__(
        self,
        modes: Sequence[str],
        size: int = SMALLEST,
        theme: str = "light",
        title: str = "",
        rows: int = 0,
    ) -> None:
        self._size = size
        self._theme = choose(THEMES, theme, "render_theme").for_modes(modes)
        self._canvas = Canvas(size, size, size / SMALLEST)
        self._modes = [f"{number} {printable(name)}" for number, name in enumerate(modes)]
        self._title, self._rows = printable(title), max(rows, legend_rows(len(modes)))

    def draw(self, history: History, beside: Sequence[History] = ()) -> NDArray[np.uint8]:
        """Draw the last epoch of a history and the trajectory so far: (size, size, 3).

        The picture depends on nothing else: the same history gives the same picture.

        Args:
            history: history to draw.
            beside: other histories of the same episode, drawn beside it: speeds and errors of all
                have the same scale.
        """
        canvas, theme, unit = self._canvas, self._theme, self._canvas.unit
        legend = unit * (15.0 * self._rows + 4.0)
        strips = unit * 160.0
        title, links = unit * (24.0 if self._title else 0.0), unit * 17.0
        header = title + unit * 20.0
        below = self._size - legend - strips
        canvas.fill(theme.paper)
        if self._title:
            pad = 8.0 * unit
            words = canvas.fitting(self._title, self._size - 2.0 * pad, 22)
            canvas.words(words, (pad, title / 2.0 + pad / 4.0), theme.ink, 22)
        self._draw_header(history, title + unit * 10.0)
        frame = Rect(0.0, header, self._size, below - links - header)
        draw_map(canvas, follow(history, frame), history, theme)
        self._draw_key(history, below - links / 2.0)
        draw_strips(canvas, Rect(0.0, below, self._size, strips), history, theme, beside)
        self._draw_modes(history, self._size - legend)
        return canvas.finish()

    def _draw_header(self, history: History, y: float) -> None:
        """Draw the numbers of the epoch in one line."""
        canvas, theme, pad = self._canvas, self._theme, 8.0 * self._canvas.unit
        error = f"error {history.error_m[-1]:.2f} m"
        if history.epochs == 0:
            numbers = f"prior   {error}"
        else:
            links = history.accepted.shape[1] - 1
            numbers = (
                f"epoch {history.epochs}   {history.time_s[-1]:g} s   "
                f"true {np.linalg.norm(history.truth[-1, 3:]):.1f} m/s   "
                f"{error}   NEES {history.nees[-1]:.3g}   "
                f"links {history.accepted[-1, :links].sum()} of {links}"
            )
        room = self._size - 3.0 * pad - canvas.width_of(numbers)
        name = canvas.fitting(printable(history.scenery.name), room)
        canvas.words(name, (pad, y), theme.ink)
        canvas.words(numbers, (self._size - pad, y), theme.ink, align=1.0)

    def _draw_key(self, history: History, y: float) -> None:
        """Draw the key of symbols and lines of the map."""
        canvas, theme, unit = self._canvas, self._theme, self._canvas.unit
        x = 12.0 * unit
        mode = theme.mode(int(history.modes[-1])) if history.epochs else theme.quiet
        canvas.disc((x, y), 4.0, theme.truth)
        x = canvas.words("user", (x + 8.0 * unit, y), theme.quiet, 14).right + 16.0 * unit
        canvas.disc((x, y), 4.0, mode)
        canvas.disc((x, y), 2.0, theme.paper)
        x = canvas.words("estimate, 2σ", (x + 8.0 * unit, y), theme.quiet, 14).right
        canvas.words("links:", (x + 16.0 * unit, y), theme.quiet, 14)
        x += 16.0 * unit + canvas.width_of("links: ", 14)
        for meaning, color, width in (
            ("accepted", theme.accepted, 1.4),
            ("rejected", theme.rejected, 1.6),
            ("missing", theme.missing, 1.4),
        ):
            start, end = (x, y), (x + 22.0 * unit, y)
            if meaning == "rejected":
                canvas.dashes(start, end, color, width)
            else:
                canvas.line(np.array([start, end]), color, width)
            x = canvas.words(meaning, (end[0] + 4.0 * unit, y), theme.quiet, 14).right
            x += 12.0 * unit

    def _draw_modes(self, history: History, top: float) -> None:
        """Draw the legend of modes, with the name of the current mode highlighted."""
        canvas, theme, unit = self._canvas, self._theme, self._canvas.unit
        columns = min(_COLUMNS, len(self._modes))
        width = (self._size - 16.0 * unit) / columns
        shown = self._modes[: _COLUMNS * _ROWS]
        for mode, name in enumerate(shown):
            left = 8.0 * unit + mode % columns * width
            y = top + (mode // columns * 15.0 + 8.0) * unit
            color, now = theme.mode(mode), int(history.modes[-1]) == mode
            canvas.fill(color, Rect(left, y - 5.0 * unit, 14.0 * unit, 10.0 * unit))
            words = canvas.fitting(name, width - 24.0 * unit, 14)
            canvas.words(words, (left + 19.0 * unit, y), theme.ink if now else theme.quiet, 14)


_GAP_SHARE = 1 / 120  # share of a picture's width, so that two maps don't look like one


class Playback:
    """Pictures of the same epoch side by side.

    Args:
        histories: histories of one episode, with equally many epochs.
        modes: names of the actions for each history.
        titles: title above each picture.
        size, theme: as :class:`~mmwave_env.rendering.picture.Picture` takes them.
    """

    def __init__(
        self,
        histories: Sequence[History],
        modes: Sequence[Sequence[str]],
        titles: Sequence[str],
        size: int,
        theme: str,
    ) -> None:
        rows = max(legend_rows(len(names)) for names in modes)  # strips at the same height
        pictures = [
            Picture(names, size, theme, title, rows)
            for names, title in zip(modes, titles, strict=True)
        ]
        self._parts = list(zip(histories, pictures, strict=True))

    def draw(self, epochs: int) -> NDArray[np.uint8]:
        """Draw all histories after so many epochs; return (size, sum of sizes, 3)."""
        known = [history.until(epochs) for history, _ in self._parts]
        drawn = [
            picture.draw(history, known)
            for history, (_, picture) in zip(known, self._parts, strict=True)
        ]
        for picture in drawn[1:]:
            picture[:, : round(_GAP_SHARE * len(picture))] = picture[0, 0]
        return np.concatenate(drawn, axis=1)
