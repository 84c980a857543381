"""Figures in the project's style (publication.mplstyle), and parts that several pictures share."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mmwave_env.io.files import atomic_path, require_writable
from mmwave_env.io.lookup import printable, require_extra, spelled
from mmwave_env.rendering.theme import THEMES, hex_of

STYLE = Path(__file__).with_name("publication.mplstyle")
UNDATED: dict[str, dict[str, Any]] = {  # metadata without dates, so equal pictures give equal files
    ".png": {},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
COLORS = [hex_of(color) for color in THEMES["light"].modes]  # colors of modes, as in videos
NO_MODE = hex_of(THEMES["light"].none)

LEGEND_COLUMNS = 2  # number of columns of a legend below panels
WIDTH_IN = 4.6  # width of a picture that fits on a phone, and in a column of a page
PANEL_IN = 3.0  # height of a panel of such a picture
ENTRY_IN = 0.25  # height of a line of its legend


def require_picture(option: str, path: Path) -> None:
    """Refuse, before any work, a picture file that can't be written; errors name ``option``.

    Raises:
        ValueError: the name does not end with .png, .svg or .pdf.
        MissingExtraError: matplotlib is not installed.
        OSError: the file can't be written.
    """
    if path.suffix.lower() not in UNDATED:
        raise ValueError(
            f"{option}: found {path}, expected a name that ends with {', '.join(UNDATED)}"
        )
    require_extra("matplotlib", "plot", f"{option}, a picture,")
    require_writable(path)


@contextmanager
def picture(path: Path, width_in: float, height_in: float) -> Iterator[Any]:
    """Yield a matplotlib figure to draw into, and write it to a .png, .svg or .pdf file at the end.

    The figure has the project's style, whatever matplotlib settings the user has. The file is
    written completely or not at all.
    """
    from matplotlib import style
    from matplotlib.figure import Figure
    from matplotlib.rcsetup import cycler

    colors = {"axes.prop_cycle": cycler(color=COLORS)}
    with style.context([STYLE, colors], after_reset=True):
        figure = Figure(figsize=(width_in, height_in))
        yield figure
        suffix = path.suffix.lower()
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format=suffix[1:], metadata=UNDATED[suffix])


def caption(name: str) -> str:
    """Return a name with escape codes for characters that are invisible or not in the font."""
    from matplotlib.font_manager import findfont, get_font

    font = get_font(findfont("DejaVu Sans"))  # the font that comes with matplotlib
    letters = printable(name)
    return "".join(x if font.get_char_index(ord(x)) else spelled(x) for x in letters)


def legend_beside(axes: Any) -> None:
    """Draw a legend to the right of a panel, where it does not cover data."""
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.02), borderaxespad=0.0)


@contextmanager
def panels(path: Path, count: int) -> Iterator[Sequence[Any]]:
    """Yield the panels of a picture, one below the other; below them, draw one legend of all."""
    height_in = PANEL_IN * count
    with picture(path, WIDTH_IN, height_in) as figure:
        drawn = figure.subplots(count, squeeze=False)[:, 0]
        yield drawn
        entries: dict[str, Any] = {}
        for axes in drawn:
            handles, labels = axes.get_legend_handles_labels()
            entries |= zip(labels, handles, strict=True)
        if entries:
            lines = -(-len(entries) // LEGEND_COLUMNS)
            figure.set_figheight(height_in + ENTRY_IN * lines)
            below = {"loc": "outside lower left", "ncols": LEGEND_COLUMNS}
            figure.legend(entries.values(), entries.keys(), **below)


def plain_numbers(axis: Any) -> None:
    """Label a logarithmic axis 1, 10, 100, ... or, if it spans few decades, 1, 2, 5, 10, ..."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    wide = high / max(low, 1e-300) > 1e3
    axis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:,g}")
    axis.set_minor_formatter(NullFormatter())
