"""Colors in light and dark, for videos; the colors of modes are also those of figures and reports.

The colors of modes are from Okabe and Ito (2008), which color-blind readers can tell apart, in an
order that keeps neighbors far apart; some are lighter or darker, to contrast with the background.
"""

from collections.abc import Sequence
from itertools import cycle
from typing import NamedTuple

from mmwave_env.io.lookup import choose, require_extra

Color = tuple[int, int, int]


class Theme(NamedTuple):
    """The colors of everything that is drawn."""

    paper: Color
    ink: Color
    quiet: Color  # color of explanations
    grid: Color
    ground: Color
    street: Color
    building: Color
    wall: Color
    truth: Color
    accepted: Color
    rejected: Color
    missing: Color
    band: Color
    none: Color  # color of an action that trusts no mode
    modes: tuple[Color, ...]

    def for_modes(self, names: Sequence[str]) -> "Theme":
        """Return the theme with a color for each action; a mode's color does not depend on "none".

        Args:
            names: names of the actions, with or without "none".
        """
        colors = cycle(self.modes)
        return self._replace(
            modes=tuple(self.none if name == "none" else next(colors) for name in names)
        )

    def mode(self, number: int) -> Color:
        """Return the color of a mode; the colors repeat if there are more modes."""
        return self.modes[number % len(self.modes)]


def hex_of(color: Color) -> str:
    """Return the color as web pages write it, such as #0072b2."""
    return "#" + bytes(color).hex()


THEMES = {
    "light": Theme(
        paper=(255, 255, 255), ink=(34, 34, 38), quiet=(104, 106, 112), grid=(214, 214, 210),
        ground=(240, 239, 234), street=(253, 253, 252), building=(228, 226, 219),
        wall=(140, 136, 128), truth=(34, 34, 38), accepted=(96, 100, 108),
        rejected=(213, 94, 0), missing=(212, 211, 206), band=(205, 211, 220), none=(190, 190, 186),
        modes=(
            (0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (140, 130, 0),
            (160, 60, 0), (86, 180, 233), (128, 128, 128), (70, 50, 130),
        ),
    ),
    "dark": Theme(
        paper=(17, 19, 24), ink=(238, 238, 235), quiet=(158, 162, 170), grid=(58, 62, 70),
        ground=(25, 28, 34), street=(42, 46, 54), building=(33, 36, 43),
        wall=(128, 130, 136), truth=(245, 245, 240), accepted=(160, 164, 172),
        rejected=(240, 120, 40), missing=(62, 66, 74), band=(62, 72, 88), none=(90, 94, 102),
        modes=(
            (86, 180, 233), (230, 159, 0), (0, 178, 130), (214, 134, 178), (240, 228, 66),
            (213, 94, 0), (60, 120, 220), (170, 170, 170), (160, 140, 230),
        ),
    ),
}  # fmt: skip


SMALLEST, LARGEST = 480, 1080  # height and width in px
FRAMES_PER_SECOND = 10  # default speed of videos and windows


def require_drawable(size: int, theme: str, what: str) -> None:
    """Refuse a picture that can't be drawn, before any work.

    Args:
        size: height and width in px.
        theme: name of the theme.
        what: what needs pictures, for the message.

    Raises:
        ValueError: the size or the theme is invalid.
        MissingExtraError: pygame is not installed.
    """
    require_extra("pygame", "render", what)
    choose(THEMES, theme, "render_theme")
    if not (SMALLEST <= size <= LARGEST and size % 2 == 0):  # video formats need an even size
        raise ValueError(
            f"render_size: found {size!r}, expected an even number from {SMALLEST} to {LARGEST}"
        )
