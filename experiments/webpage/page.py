"""The page as one file: template, style, script and data."""

import json
import re
from collections.abc import Callable
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from experiments.console.provenance import command_line
from experiments.webpage.contents import assembled
from experiments.webpage.kinds import COMPARISON, TRACK
from experiments.webpage.markup import text
from experiments.webpage.played import Played, play
from experiments.webpage.sections import Page
from experiments.webpage.source import Source
from experiments.webpage.sources import read_source
from mmwave_env.files import write_text

if TYPE_CHECKING:
    from experiments.report import Args

LARGEST_BYTES = 5_000_000
SCRIPTS = ("drawing.js", "charts.js", "stanford.js", "map.js", "browser.js", "page.js")


def write_page(args: "Args", localized: Callable[[Source], Played] | None = None) -> int:
    """Read results and write the page of them.

    Args:
        args: what to read, what to play again, where to write.
        localized: the begin of the track of a log, to be watched; None where there are no logs.

    Returns:
        The size of the page, bytes.

    Raises:
        ValueError: results that can't be read, or so much that the page gets too large.
        FileNotFoundError: there are none.
    """
    sources = [source for path in args.results for source in read_source(path)]
    played = {
        number: play(source, args.episodes, args.watch)
        for number, source in enumerate(sources)
        if source.kind is COMPARISON
    }
    if localized:
        logs = {n: source for n, source in enumerate(sources) if source.kind is TRACK}
        played |= {number: localized(source) for number, source in logs.items()}
    page = html_of(assembled(sources, played), command_line("report", args))
    size = len(page.encode())
    if size > LARGEST_BYTES:
        raise ValueError(
            f"results: found enough for a page of {size / 1e6:.1f} MB, expected at most "
            f"{LARGEST_BYTES / 1e6:g} MB; fewer results, or --watch less than {args.watch}"
        )
    write_text(args.out, page)
    return size


def html_of(page: Page, command: str) -> str:
    """The whole page; what is put into the template is never looked at again."""
    titles = {title: re.sub(r"\W+", "-", title.lower()) for title in page.sections}
    parts = {
        "style": _file("page.css"),
        "script": "\n".join(map(_file, SCRIPTS)),
        "command": text(command),
        "tabs": "".join(
            f'<button type="button" role="tab" id="tab-{name}" aria-controls="panel-{name}">'
            f"{text(title)}</button>"
            for title, name in titles.items()
        ),
        "sections": "".join(
            f'<section role="tabpanel" id="panel-{name}" aria-labelledby="tab-{name}" tabindex="0">'
            f"<h2>{text(title)}</h2>{page.sections[title]}</section>"
            for title, name in titles.items()
        ),
        "data": in_script(page.data),
    }
    return re.sub(r"<!--(\w+)-->", lambda found: parts[found[1]], _file("page.html"))


def _file(name: str) -> str:
    return (files("experiments.webpage") / name).read_text(encoding="utf-8")


def in_script(data: Any) -> str:
    """JSON that can stand in a script element: nothing in it ends or comments the element."""
    found = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return found.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
