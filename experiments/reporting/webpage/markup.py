"""HTML for names and other text, for tables, and for pictures of the folder ``figures``."""

from base64 import b64encode
from collections.abc import Callable, Sequence
from html import escape
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from experiments.console.tables import CELL, unescaped
from mmwave_env.io.lookup import printable

SHOWN = 5  # number of table rows that are shown at first


def text(value: Any) -> str:
    """Escape text for HTML, including quoted attributes; spell out unprintable characters."""
    return escape(printable(str(value)))


def element(tag: str, words: Any, kind: str = "") -> str:
    """Return an HTML element that contains plain text."""
    return f"<{tag}{kind and f' class={kind}'}>{text(words)}</{tag}>"


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table of plain text that scrolls sideways; the first cell of each row names the row.

    Rows after the first :data:`SHOWN` are hidden until a box is checked; this needs no script.
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
    """Return a picture as HTML; without matplotlib, return a note.

    ``draw`` writes the picture to an .svg file. In dark mode, the page's style inverts the picture.
    """
    if not find_spec("matplotlib"):
        return element("p", f"{caption}: pictures need mmwave-loc[plot]", "note")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.svg"
        draw(path)
        svg = b64encode(path.read_bytes()).decode("ascii")
    image = f'<img src="data:image/svg+xml;base64,{svg}" alt="{text(caption)}">'
    return f"<figure>{image}{element('figcaption', caption)}</figure>"
