"""Size and speed of pictures, known without pygame."""

from mmwave_env.lookup import choose, require_extra
from mmwave_env.rendering.theme import THEMES

SMALLEST, LARGEST = 480, 1080  # px, height and width
FRAMES_PER_SECOND = 10  # of videos, and of a window until a key changes it


def require_drawable(size: int, theme: str, what: str) -> None:
    """Refuse what can't be drawn, before any work.

    Args:
        size: px, height and width.
        theme: of the colors.
        what: needs pictures.

    Raises:
        ValueError: a size or a theme that there is not.
        MissingExtraError: pygame is not installed.
    """
    require_extra("pygame", "render", what)
    choose(THEMES, theme, "render_theme")
    if not (SMALLEST <= size <= LARGEST and size % 2 == 0):  # videos take no odd sizes
        raise ValueError(
            f"render_size: found {size!r}, expected an even number from {SMALLEST} to {LARGEST}"
        )
