"""HTML for names and other text, for tables, and for pictures from ``experiments.figures``."""

import hashlib
import re
from collections.abc import Callable, Sequence
from html import escape
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from experiments.console.tables import CELL, unescaped
from experiments.figures.canvas import COLORS, NO_MODE
from mmwave_env.io.lookup import printable

SHOWN = 5  # number of rows that are shown at first
VARIABLES = {  # variables of the page's style, by color in pictures
    "#000000": "var(--ink)",
    "#ffffff": "var(--paper)",
    "#b3b3b3": "var(--band)",
    NO_MODE: "var(--none)",
    **{color: f"var(--mode-{number})" for number, color in enumerate(COLORS)},
}
COLOR = re.compile("|".join(VARIABLES))
TAG = re.compile(r"<[^>]*>")  # a tag in matplotlib's SVG, which escapes > in attributes
OWN = re.compile(r"<style.*?</style>|<metadata>.*?</metadata>", re.DOTALL)  # parts to leave out
NAMED = re.compile(r'( id="|="#|url\(#)')  # precedes the name of an element


def text(value: Any) -> str:
    """Return plain text as HTML that shows every character, also in a quoted attribute."""
    return escape(printable(str(value)))


def element(tag: str, words: Any, kind: str = "") -> str:
    """Return an HTML element that contains plain text."""
    return f"<{tag}{kind and f' class={kind}'}>{text(words)}</{tag}>"


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table of plain text that scrolls sideways; the first cell names its row.

    Rows after the first :data:`SHOWN` are hidden until a box is checked, which needs no script.
    """
    head = "".join(f'<th scope="col">{text(title)}</th>' for title in header)
    body = "".join(
        f'<tr><th scope="row">{text(name)}</th>{"".join(element("td", c) for c in cells)}</tr>'
        for name, *cells in rows
    )
    more = f'<label><input type="checkbox"> Show all {len(rows)} rows</label>'
    return (
        f'<div class="table">{element("p", caption, "caption") if caption else ""}'
        f'<div class="scroll" tabindex="0" role="region" aria-label="{text(caption or header[0])}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
        f"{more if len(rows) > SHOWN else ''}</div>"
    )


def html_of(markdown: str) -> str:
    """Return tables, paragraphs and list items of a command's Markdown as HTML."""
    parts = []
    for block in markdown.strip().split("\n\n"):
        lines = block.strip().splitlines()
        if block.startswith("|"):
            cells = [[unescaped(c.strip()) for c in CELL.findall(line[1:])] for line in lines]
            parts.append(table("", cells[0], cells[2:]))
        else:
            parts += [element("p", unescaped(line.removeprefix("- "))) for line in lines]
    return "".join(parts)


def drawn(caption: str, draw: Callable[[Path], None]) -> str:
    """Return a picture whose colors adapt to light and dark mode; without matplotlib, a note.

    ``draw`` writes the picture to an .svg file.
    """
    if not find_spec("matplotlib"):
        return element("p", f"{caption}: pictures need mmwave-loc[plot]", "note")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.svg"
        draw(path)
        svg = path.read_text("utf-8")
    prefix = f"p{hashlib.sha256(svg.encode()).hexdigest()[:8]}-"  # makes ids unique in the page

    def adapted(tag: re.Match[str]) -> str:
        return NAMED.sub(rf"\1{prefix}", COLOR.sub(lambda color: VARIABLES[color[0]], tag[0]))

    svg = TAG.sub(adapted, OWN.sub("", svg[svg.index("<svg") :]))
    words = element("figcaption", caption)
    return f'<figure role="img" aria-label="{text(caption)}">{svg}{words}</figure>'
