"""The web page as one file, made from a template, a style sheet, scripts and data."""

import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from experiments.console.options import PageArgs
from experiments.console.provenance import command_line
from experiments.reporting.webpage.contents import READ, Verdict, origin_of, read_source, verdict_on
from experiments.reporting.webpage.markup import element, text
from experiments.reporting.webpage.played import LONGEST, Played, errors_of, play
from mmwave_env.io.files import first_line
from mmwave_env.rendering.theme import THEMES, hex_of

SCRIPTS = ("drawing.js", "map.js", "player.js")


def page_of(args: PageArgs) -> str:
    """Return the web page of results; refuse results that can't be read."""
    sources = [read_source(path) for path in args.results]
    verdicts = []
    origins = []
    for source in sources:
        content = source.content
        try:
            verdicts.append(verdict_on(source))
            versions = content.get("versions", {})
            origins.append(origin_of(source.path, content["command"], versions))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{source.path}: {first_line(error)}, expected {READ}") from error
    origins.append(origin_of("This page", command_line("report", args), {}))
    played = [play(source, args.episodes, args.watch) for source in sources]
    errors = ["".join(errors_of(part)) for part in played]
    sections = {
        "Results": _folded(verdicts, [verdict.tables for verdict in verdicts]),
        "Errors": _folded(verdicts, errors),
        "Episodes": _player(verdicts, played),
        "How it was made": "".join(origins),
    }
    shown = [episode for part in played for episode in part.shown]
    return _html(verdicts, sections, {"episodes": shown})


def _folded(verdicts: Sequence[Verdict], parts: Sequence[str]) -> str:
    """Return collapsible parts, each titled by its verdict's name; only the first is open."""
    named = [(verdict.name, part) for verdict, part in zip(verdicts, parts, strict=True) if part]
    return "".join(
        f"<details{'' if number else ' open'}><summary>{text(name)}</summary>{part}</details>"
        for number, (name, part) in enumerate(named)
    )


def _player(verdicts: Sequence[Verdict], played: Sequence[Played]) -> str:
    """Return the element of the player, with notes on episodes that can't be watched."""
    parts = []
    if any(source.shown for source in played):
        parts = ['<div id="player"><noscript>Only this section needs JavaScript.</noscript></div>']
    for verdict, source in zip(verdicts, played, strict=True):
        notes = [
            f"{f'{name} was not' if name else 'no episode was'} played again: {why}"
            for name, why in source.missing.items()
        ]
        if any(len(episode["time_s"]) == LONGEST for episode in source.shown):
            notes.append(f"the first {LONGEST} epochs are shown")
        parts += [element("p", f"{verdict.name}: {note}", "note") for note in notes]
    return "".join(parts)


def _html(verdicts: Sequence[Verdict], sections: Mapping[str, str], data: Any) -> str:
    """Return the complete page; placeholders in inserted text are not replaced."""
    # In JSON, the signs <, > and & are escaped, so that no text can end the script element.
    content = json.dumps(data, allow_nan=False, separators=(",", ":"))
    titles = {re.sub(r"\W+", "-", t.lower()): t for t, section in sections.items() if section}
    parts = {
        "title": text(verdicts[0].title),
        "lead": "".join(element("p", verdict.sentence) for verdict in verdicts),
        "style": _colors() + _file("page.css"),
        "script": "".join(map(_file, SCRIPTS)),
        "links": "".join(f'<a href="#{name}">{text(title)}</a>' for name, title in titles.items()),
        "sections": "".join(
            f'<section id="{name}"><h2>{text(title)}</h2>{sections[title]}</section>'
            for name, title in titles.items()
        ),
        "data": content.translate({ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&"}),
    }
    return re.sub(r"<!--(\w+)-->", lambda mark: parts[mark[1]], _file("page.html"))


def _colors() -> str:
    """Return the page's colors, which videos also have, as CSS variables."""
    light = THEMES["light"]._asdict()
    dark = THEMES["dark"]._asdict()
    lines = (
        f"--{name}: light-dark({hex_of(light[name])}, {hex_of(dark[name])});"
        for name in light.keys() - {"modes"}
    )
    return f":root {{ {' '.join(sorted(lines))} }}\n"


def _file(name: str) -> str:
    return (files("experiments.reporting.webpage") / name).read_text(encoding="utf-8")
