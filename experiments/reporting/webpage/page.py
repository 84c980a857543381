"""The web page as one file, made of template, style, script and data."""

import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

from experiments.console.options import PageArgs
from experiments.console.provenance import command_line
from experiments.reporting.webpage.contents import Verdict, errors_of, origin_of, results_of
from experiments.reporting.webpage.localized_log import localized
from experiments.reporting.webpage.markup import element, text
from experiments.reporting.webpage.played import LONGEST, Played, play
from experiments.reporting.webpage.sources import READ, read_source
from mmwave_env.io.files import told
from mmwave_env.rendering.theme import THEMES, hex_of

SCRIPTS = ("drawing.js", "map.js", "player.js")


def page_of(args: PageArgs) -> str:
    """Return the web page of results.

    Args:
        args: results to read, and numbers of episodes to play again.

    Raises:
        ValueError: the results can't be read.
        FileNotFoundError: there is no such file.
    """
    sources = [source for path in args.results for source in read_source(path)]
    verdicts, results, origins = [], [], []
    for source in sources:
        try:
            verdict, tables = results_of(source)
            command, versions = source.content["command"], source.content.get("versions", {})
            origins.append(origin_of(source.path, command, versions))
            list(errors_of(source, Played()))  # refuses results that can't be shown before any work
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{source.path}: {told(error)}, expected {READ}") from error
        verdicts.append(verdict)
        results.append(tables)
    origins.append(origin_of("This page", command_line("report", args), {}))
    again = {"comparison": lambda one: play(one, args.episodes, args.watch), "track": localized}
    played = [again.get(source.kind, lambda _: Played())(source) for source in sources]
    errors = ["".join(errors_of(source, one)) for source, one in zip(sources, played, strict=True)]
    sections = {
        "Results": _folded(verdicts, results),
        "Errors": _folded(verdicts, errors),
        "Episodes": _player(verdicts, played),
        "How it was made": "".join(origins),
    }
    episodes = [one for some in played for one in some.shown if one["contenders"]]
    return _html(verdicts, sections, {"episodes": episodes})


def _folded(verdicts: Sequence[Verdict], parts: Sequence[str]) -> str:
    """Return the part of each source under its name, all but the first folded."""
    there = [(one.name, part) for one, part in zip(verdicts, parts, strict=True) if part]
    return "".join(
        f"<details{'' if number else ' open'}><summary>{text(name)}</summary>{part}</details>"
        for number, (name, part) in enumerate(there)
    )


def _player(verdicts: Sequence[Verdict], played: Sequence[Played]) -> str:
    """Return the element of the player, with notes on episodes that can't be watched."""
    parts = []
    if any(one.shown for one in played):
        parts = ['<div id="player"><noscript>Only this section needs JavaScript.</noscript></div>']
    for verdict, one in zip(verdicts, played, strict=True):
        missing = one.missing.items()
        notes = [
            f"{f'{who} was not' if who else 'no episode was'} played again: {why}"
            for who, why in missing
        ]
        if any(episode["cut"] for episode in one.shown):
            notes.append(f"the first {LONGEST} epochs are shown")
        parts += [element("p", f"{verdict.name}: {note}", "note") for note in notes]
    return "".join(parts)


def _html(verdicts: Sequence[Verdict], sections: Mapping[str, str], data: Any) -> str:
    """Return the whole page; text that fills the template is not searched for marks."""
    there = {re.sub(r"\W+", "-", title.lower()): title for title, part in sections.items() if part}
    parts = {
        "title": text(verdicts[0].title),
        "lead": "".join(element("p", one.sentence) for one in verdicts),
        "style": _colors() + _file("page.css"),
        "script": "".join(map(_file, SCRIPTS)),
        "links": "".join(f'<a href="#{name}">{text(title)}</a>' for name, title in there.items()),
        "sections": "".join(
            f'<section id="{name}"><h2>{text(title)}</h2>{sections[title]}</section>'
            for name, title in there.items()
        ),
        "data": in_script(data),
    }
    return re.sub(r"<!--(\w+)-->", lambda found: parts[found[1]], _file("page.html"))


def _colors() -> str:
    """Return the colors of films as variables of the style."""
    light, dark = THEMES["light"], THEMES["dark"]
    pairs = {name: (getattr(light, name), getattr(dark, name)) for name in light._fields}
    both = zip(*pairs.pop("modes"), strict=True)
    pairs |= {f"mode-{number}": pair for number, pair in enumerate(both)}
    lines = (f"--{name}: light-dark({hex_of(a)}, {hex_of(b)});" for name, (a, b) in pairs.items())
    return f":root {{ {' '.join(lines)} }}\n"


def _file(name: str) -> str:
    return (files("experiments.reporting.webpage") / name).read_text(encoding="utf-8")


def in_script(data: Any) -> str:
    """Return JSON that is safe in a script element: nothing in it can end the element."""
    found = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return found.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
