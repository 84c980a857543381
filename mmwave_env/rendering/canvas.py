"""Canvas for drawing shapes and words on a pygame surface."""

import math
import os
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.io.lookup import MissingExtraError, printable
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.theme import SMALLEST, Paint, Pixels, Theme

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # otherwise pygame prints a greeting
import pygame

Point = tuple[float, float]
if not hasattr(pygame, "FRect"):
    raise MissingExtraError(
        "pictures need pygame-ce, whose files pygame has overwritten: pip uninstall pygame "
        "pygame-ce, then pip install pygame-ce"
    )
Rect = pygame.FRect  # a part of a picture, in units (see Canvas) from the upper left
UNITS = float(SMALLEST)  # height and width of a picture, in units
_TIMES = 2  # factor of supersampling, for smooth edges
_FAR = 2e4  # limit of coordinates in the supersampled picture, px
_DASH = 5.0  # length of dashes and of the gaps between them, units


class Canvas:
    """A square picture that is being drawn, ``size`` px wide; text is drawn over all shapes.

    Coordinates, line widths and font sizes are in units; a unit is 1 px in the smallest picture.
    """

    def __init__(self, size: int, theme: Theme) -> None:
        self.color = theme.color
        self._unit = size / UNITS
        self._scale = _TIMES * self._unit
        self._large = pygame.Surface((size * _TIMES, size * _TIMES), 0, 32)
        self._words: list[tuple[Any, Point]] = []
        self._large.fill(self.color("paper"))

    def clip(self, part: Rect | None) -> None:
        """Draw the following shapes only inside a part of the picture; None removes the limit."""
        self._large.set_clip(part and self._scaled(part))

    def fill(self, paint: Paint, part: Rect) -> None:
        """Fill a part of the picture."""
        self._large.fill(self.color(paint), self._scaled(part))

    def polygon(self, points: ArrayLike, paint: Paint) -> None:
        """Fill a polygon (n, 2)."""
        pygame.draw.polygon(self._large, self.color(paint), self._enlarged(points))

    def line(self, points: ArrayLike, paint: Paint, width: float, closed: bool = False) -> None:
        """Draw a line through at least two points (n, 2)."""
        thick = max(1, round(width * self._scale))
        pygame.draw.lines(self._large, self.color(paint), closed, self._enlarged(points), thick)

    def dashes(self, start: Point, end: Point, paint: Paint, width: float) -> None:
        """Draw a dashed line between two points in the picture."""
        count = 1 + int(math.dist(start, end) / (2.0 * _DASH))
        for dash in np.linspace(start, end, 2 * count).reshape(count, 2, 2):
            self.line(dash, paint, width)

    def disc(self, center: Point | Array, radius: float, paint: Paint) -> None:
        """Draw a filled circle."""
        middle = self._enlarged(center).tolist()
        pygame.draw.circle(self._large, self.color(paint), middle, radius * self._scale)

    def words(
        self,
        text: str,
        at: Point,
        paint: Paint,
        size: float = 14.0,
        align: float = 0.0,
        room: float = math.inf,
    ) -> float:
        """Write one line of text, centered vertically at a point; return its right end.

        ``align`` is the fraction of the text's width that is left of the point. If the text is
        wider than ``room``, its end is replaced by "...".
        """
        text = printable(text)
        shown = text
        while text and self.width_of(shown, size) > room:
            text = text[:-1]
            shown = f"{text}..."
        drawn = _font(round(size * self._unit)).render(shown, True, self.color(paint))
        width, height = drawn.get_size()
        left = at[0] * self._unit - align * width
        self._words.append((drawn, (round(left), round(at[1] * self._unit - height / 2.0))))
        return float(left + width) / self._unit

    def width_of(self, text: str, size: float = 14.0) -> float:
        """Return the width of a line of words."""
        return float(_font(round(size * self._unit)).size(text)[0] / self._unit)

    def finish(self) -> Pixels:
        """Combine shapes and words; return the picture (height, width, 3)."""
        surface = pygame.transform.smoothscale_by(self._large, 1.0 / _TIMES)
        surface.blits(self._words, False)
        return np.ascontiguousarray(pygame.surfarray.array3d(surface).swapaxes(0, 1))

    def _enlarged(self, points: ArrayLike) -> Array:
        """Return points (n, 2) in the coordinates of the large surface."""
        # np.clip would keep NaN; fmin and fmax replace it with a limit
        enlarged = np.multiply(points, self._scale)
        return np.fmax(np.fmin(enlarged, _FAR), -_FAR)  # type: ignore[no-any-return]

    def _scaled(self, part: Rect) -> pygame.Rect:
        """Return a part of the picture in the coordinates of the large surface."""
        corners = np.multiply([part.topleft, part.bottomright], self._scale)
        low, high = np.rint(corners).astype(int)
        return pygame.Rect(low, high - low)


_FONTS: dict[int, Any] = {}  # by size


def _font(size: int) -> Any:
    """Return the default font; anybody's ``pygame.quit()`` ends the fonts made before."""
    with suppress(KeyError, pygame.error):
        _FONTS[size].get_height()
        return _FONTS[size]
    pygame.font.init()
    _FONTS[size] = pygame.font.Font(None, size)
    return _FONTS[size]
