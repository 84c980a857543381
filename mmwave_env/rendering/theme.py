"""Light and dark colors for videos; figures and reports use the same colors for modes.

The colors of modes are based on the palette of Okabe and Ito (2008), which color-blind readers can
distinguish. Some are lighter or darker than in the palette, to contrast with the background.
Consecutive colors differ clearly.
"""

from collections.abc import Sequence
from itertools import cycle
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from mmwave_env.io.lookup import choose, require_extra

Pixels = NDArray[np.uint8]  # (height, width, 3) red, green and blue
Color = tuple[int, ...]  # red, green and blue, 0 to 255
Paint = str | int  # the name of a color in the theme, or the number of a mode

# Name, light color, dark color. "quiet" is for explanations, "none" for the action "none".
_COLORS = """\
    paper     ffffff 111318
    ink       222226 eeeeeb
    quiet     686a70 9ea2aa
    grid      d6d6d2 3a3e46
    ground    f0efea 191c22
    street    fdfdfc 2a2e36
    building  e4e2db 21242b
    wall      8c8880 808288
    truth     222226 f5f5f0
    accepted  60646c a0a4ac
    rejected  d55e00 f07828
    missing   d4d3ce 3e424a
    band      cdd3dc 3e4858
    none      bebeba 5a5e66
    mode      0072b2 56b4e9
    mode      e69f00 e69f00
    mode      009e73 00b282
    mode      cc79a7 d686b2
    mode      8c8200 f0e442
    mode      a03c00 d55e00
    mode      56b4e9 3c78dc
    mode      808080 aaaaaa
    mode      463282 a08ce6
"""


class Theme(SimpleNamespace):
    """The colors of everything that is drawn, by the names in ``_COLORS``; ``modes`` is a tuple."""

    def for_modes(self, names: Sequence[str]) -> "Theme":
        """Return the theme with one color per action.

        The action "none" has its own color, so that it does not shift the colors of the modes.
        """
        colors = cycle(self.modes)
        modes = tuple(self.none if name == "none" else next(colors) for name in names)
        return Theme(**vars(self) | {"modes": modes})

    def color(self, paint: Paint) -> Color:
        """Return the color of this name, or of the mode with this number.

        Colors repeat if there are more modes than colors. The prior, which no mode computed and
        whose number is negative, is quiet.
        """
        if isinstance(paint, str):
            color: Color = getattr(self, paint)
        else:
            color = self.modes[paint % len(self.modes)] if paint >= 0 else self.quiet
        return color


def hex_of(color: Color) -> str:
    """Return a color in the notation of web pages, such as #0072b2."""
    return "#" + bytes(color).hex()


def _theme(column: int) -> Theme:
    """Return the theme in a column of ``_COLORS``: 1 for light, 2 for dark."""
    rows = [line.split() for line in _COLORS.splitlines()]
    colors = [(row[0], tuple(bytes.fromhex(row[column]))) for row in rows]
    modes = tuple(color for name, color in colors if name == "mode")
    return Theme(modes=modes, **{name: color for name, color in colors if name != "mode"})


THEMES = {"light": _theme(1), "dark": _theme(2)}
# limits of the height and width of a picture, px
SMALLEST = 480
LARGEST = 1080
FRAMES_PER_SECOND = 10  # default number of pictures per second in videos and windows


def require_drawable(size: int, theme: str, purpose: str) -> None:
    """Refuse a picture that can't be drawn, before any work is done.

    If a package is missing, the message names the ``purpose`` of the picture.

    Raises:
        ValueError: the size (in px) or the theme is invalid.
        MissingExtraError: pygame is not installed.
    """
    require_extra("pygame", "render", purpose)
    choose(THEMES, theme, "render_theme")
    known = range(SMALLEST, LARGEST + 1, 2)  # video formats need an even size
    if not (isinstance(size, int | np.integer) and size in known):
        raise ValueError(
            f"render_size: found {size!r}, expected an even number from {SMALLEST} to {LARGEST}"
        )
