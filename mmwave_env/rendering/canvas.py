"""Canvas for drawing shapes and words on a pygame surface."""

import math
import os
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.theme import Color

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame would print its greeting
import pygame

Point = tuple[float, float]
Rect = pygame.FRect  # a part of a picture, px from its upper left corner
_TIMES = 2  # factor of supersampling, for smooth edges
_FAR = 1e4  # px; larger coordinates are reduced to this


class Canvas:
    """A picture that is being drawn, ``width`` x ``height`` px; words appear above all shapes.

    Line widths and font sizes are in units of ``unit`` px, which is 1 in the smallest picture.
    """

    def __init__(self, width: int, height: int, unit: float) -> None:
        pygame.font.init()
        self.unit = unit
        self._large = pygame.Surface((width * _TIMES, height * _TIMES), 0, 32)
        self.surface = pygame.Surface((width, height), 0, 32)
        self._words: list[tuple[Any, Point]] = []

    def clip(self, part: Rect | None) -> None:
        """Draw the following shapes only inside a part of the picture; None for all of it."""
        self._large.set_clip(None if part is None else _scaled(part))

    def fill(self, color: Color, part: Rect | None = None) -> None:
        """Fill a part of the picture, or all of it."""
        self._large.fill(color, None if part is None else _scaled(part))

    def polygon(self, points: Array, color: Color, opacity: float = 1.0) -> None:
        """Fill a polygon (n, 2)."""
        large = _large(points)
        if opacity == 1.0:
            pygame.draw.polygon(self._large, color, large)
            return
        low, high = large.min(axis=0), large.max(axis=0)
        box = pygame.Rect(low, high - low + 1).clip(self._large.get_clip())
        glass = pygame.Surface(box.size, pygame.SRCALPHA)
        pygame.draw.polygon(glass, (*color, round(255 * opacity)), large - box.topleft)
        self._large.blit(glass, box)

    def line(self, points: Array, color: Color, width: float = 1.0, closed: bool = False) -> None:
        """Draw a line through at least two points (n, 2)."""
        pygame.draw.lines(self._large, color, closed, _large(points), self._width(width))

    def dashes(self, start: Point, end: Point, color: Color, width: float = 1.0) -> None:
        """Draw a dashed line between two points in the picture."""
        way, dash = np.subtract(end, start), 5.0 * self.unit
        length = math.hypot(*way)
        for i in range(math.ceil(length / (2.0 * dash))):
            shares = 2.0 * i * dash / length, min((2.0 * i + 1.0) * dash / length, 1.0)
            self.line(start + np.outer(shares, way), color, width)

    def disc(self, center: Point, radius: float, color: Color) -> None:
        """Draw a filled circle, whose radius is given in units."""
        (middle,) = _large(np.array([center])).tolist()
        pygame.draw.circle(self._large, color, middle, radius * self.unit * _TIMES)

    def words(
        self, text: str, at: Point, color: Color, size: float = 15.0, align: float = 0.0
    ) -> Rect:
        """Write one line of text, centered vertically at a point; return the part that it covers.

        Pass text from users through :func:`~mmwave_env.io.lookup.printable`. ``size`` is in units.
        ``align`` is the share of the text's width that is left of the point.
        """
        drawn = _font(round(size * self.unit)).render(text, True, color)
        width, height = drawn.get_size()
        place = Rect(at[0] - align * width, at[1] - height / 2.0, width, height)
        self._words.append((drawn, (round(place.left), round(place.top))))
        return place

    def width_of(self, text: str, size: float = 15.0) -> float:
        """Return the width of a line of words, px."""
        return float(_font(round(size * self.unit)).size(text)[0])

    def fitting(self, text: str, width: float, size: float = 15.0) -> str:
        """Return the text, shortened to a width in px if it is wider."""
        if self.width_of(text, size) <= width:
            return text
        cut = (f"{text[:kept]}..." for kept in range(len(text), -1, -1))
        return next((words for words in cut if self.width_of(words, size) <= width), "...")

    def finish(self) -> NDArray[np.uint8]:
        """Combine shapes and words; return the picture (height, width, 3)."""
        pygame.transform.smoothscale(self._large, self.surface.get_size(), self.surface)
        self.surface.blits(self._words, False)
        self._words = []
        width, height = self.surface.get_size()
        pixels = np.frombuffer(pygame.image.tobytes(self.surface, "RGB"), np.uint8)
        return pixels.reshape(height, width, 3).copy()

    def _width(self, units: float) -> int:
        return max(1, round(units * self.unit * _TIMES))


@lru_cache(maxsize=32)
def _font(size: int) -> Any:
    pygame.font.init()
    return pygame.font.Font(None, size)


def _large(points: Array) -> Array:
    """Return points (n, 2) in the coordinates of the large surface."""
    # np.clip would keep NaN; these functions replace NaN with a limit
    return np.fmax(np.fmin(points, _FAR), -_FAR) * _TIMES  # type: ignore[no-any-return]


def _scaled(part: Rect) -> tuple[int, int, int, int]:
    left, top, right, bottom = (round(edge * _TIMES) for edge in (*part.topleft, *part.bottomright))
    return left, top, right - left, bottom - top


def ellipse(center: Array, P: Array, deviations: float) -> Array:
    """Return the outline (n, 2) of a covariance (2, 2) at this number of standard deviations."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    variances, axes = np.linalg.eigh(P)
    lengths = np.sqrt(np.maximum(variances, 0.0))
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return center + deviations * (circle * lengths) @ axes.T  # type: ignore[no-any-return]
