"""The web page as one file, made from a template, a style sheet, scripts and data.

First come parts of HTML; then the sources of results, with verdicts, tables and learning curves.
Results files do not store single epochs, so the page plays some episodes, or a log, again.
"""

import csv
import json
import re
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from importlib.resources import files
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from experiments.console.options import EpisodeArgs, LogArgs, PageArgs
from experiments.console.output import cells_of, unescaped
from experiments.console.provenance import command_line, options_from
from experiments.evaluation.agents import is_agent
from experiments.evaluation.compare import Comparison
from experiments.evaluation.contenders import (
    DESCRIPTIONS,
    contender_of,
    named,
    outcomes_markdown,
    seeds_from,
    task_of,
)
from experiments.evaluation.positions import EpochErrors, positions_markdown
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.reporting.figures import draw_consistency, draw_error_cdf, draw_learning_curves
from experiments.reporting.histories import histories_of
from experiments.reporting.log_results import beginning
from experiments.reporting.track_report import track_markdown
from mmwave_env.io.files import Json, first_line, read_json, read_text
from mmwave_env.io.lookup import printable
from mmwave_env.logs.truth import velocity_of
from mmwave_env.metrics import nees_interval
from mmwave_env.models.prior import GAP_S
from mmwave_env.numerics.ellipses import axes_of
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import POSITION_NUMBERS, History
from mmwave_env.rendering.theme import THEMES, hex_of

SHOWN = 5  # number of table rows that are shown at first


def text(value: Any) -> str:
    """Escape text for HTML, including quoted attributes; spell out unprintable characters."""
    return escape(printable(str(value)))


def element(tag: str, words: Any, kind: str = "") -> str:
    """Return an HTML element that contains plain text."""
    return f"<{tag}{kind and f' class={kind}'}>{text(words)}</{tag}>"


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
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
        '<div class="table">'
        f'<div class="scroll" tabindex="0" role="region" aria-label="{text(header[0])}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
        f"{more if len(rows) > SHOWN else ''}</div>"
    )


def html_of(markdown: str) -> str:
    """Return tables, paragraphs and list items of a command's Markdown as HTML."""
    parts = []
    for block in markdown.strip().split("\n\n"):
        if block.startswith("|"):
            header, _, *rows = cells_of(block)
            parts.append(table(header, rows))
        else:
            lines = block.strip().splitlines()
            parts += [element("p", unescaped(line.removeprefix("- "))) for line in lines]
    return "".join(parts)


def drawn(caption: str, draw: Callable[..., None], *data: Any) -> str:
    """Return a picture of data as HTML; without matplotlib, return a note.

    ``draw`` gets the data and the path of an .svg file to write. In dark mode, the
    page's style inverts the picture.
    """
    if not find_spec("matplotlib"):
        return element("p", f"{caption}: pictures need mmwave-loc[plot]", "note")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.svg"
        draw(*data, path)
        svg = b64encode(path.read_bytes()).decode("ascii")
    image = f'<img src="data:image/svg+xml;base64,{svg}" alt="{text(caption)}">'
    return f"<figure>{image}{element('figcaption', caption)}</figure>"


def curves_of(log: Path) -> dict[str, tuple[list[float], list[float]]]:
    """Read the learning curves in a log: for each rival, steps and reward minus its reward.

    Raises:
        ValueError: the log is not CSV, or a value is not a number; the message names the line.
    """
    curves: dict[str, tuple[list[float], list[float]]] = {}
    rows = csv.DictReader(StringIO(read_text(log, "the progress log of a training"), newline=""))
    try:
        for row in rows:
            for name, value in row.items():
                if value and name.startswith("tuning/minus "):
                    steps, values = curves.setdefault(name.split(" ", 1)[1], ([], []))
                    steps.append(float(row["timesteps"]))
                    values.append(float(value))
    except (csv.Error, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{log}: line {rows.line_num}: {first_line(error)[:300]}") from error
    return curves


READ = "results (--json) of compare, demo or localize, or a folder that train wrote"


class Source(NamedTuple):
    """Results of one command."""

    path: str  # path as the user typed it
    kind: str  # "comparison", "track" or "run"
    content: Json  # content of a file; or a run's summary, with learning curves as "curves"


def read_source(path: Path) -> Source:
    """Read a file of results, or the folder of a finished or unfinished run.

    Raises:
        ValueError: the file does not hold results; the message names the file and what it lacks.
        FileNotFoundError: there is no such file.
    """
    over = path / "summary.json"
    begun = path / "run.json"
    if over.is_file():
        run = read_json(over, "the summary of a run", dict)
    elif begun.is_file():
        run = read_json(begun, "the manifest of a run", dict)
        outcomes = sorted(path.glob("seed-*/outcome.json"))
        run["seeds"] = [read_json(file, "the outcome of a training", dict) for file in outcomes]
    else:
        content = read_json(path, "results", dict)
        return Source(str(path), "track" if "groups" in content else "comparison", content)
    logs = sorted(path.glob("seed-*/progress.csv"))
    run["curves"] = {file.parent.name: curves_of(file) for file in logs}
    return Source(str(path), "run", run)


WORDS = (
    "Means ± half the widths of their 95 % intervals, best reward first. reward: per epoch, minus "
    "the position error in m, and minus a penalty if the filter misjudges its error. ATE: mean "
    "position error. RMSE: root of the mean square error. RPE: change of the error within a "
    "second. NEES: squared error relative to the filter's own covariance; 3 is right (2 on flat "
    "ground), more is too confident. diverged: share of episodes whose error exceeds 50 m at some "
    "time. Wide tables scroll sideways."
)


class Verdict(NamedTuple):
    """A name for results, their outcome as a title and as a sentence, and HTML of their tables."""

    name: str
    title: str
    sentence: str
    tables: str


def verdict_on(source: Source) -> Verdict:
    """Return the verdict on the results of a source.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the content is not complete.
    """
    content = source.content
    if source.kind == "track":
        log = content["log"]
        times = f"{content['first_s']:.13g} to {content['last_s']:.13g} s"
        title = f"{content['epochs']} epochs of {log}, {times}"
        facts = [title]
        for name, row in content.get("truth", {"tracks": {}})["tracks"].items():
            facts.append(f"the {name} track has an ATE of {row['ate_m']:.3f} m")
        if content.get("error"):
            facts.append(f"only part of the log was used: {content['error']}")
        tables = html_of(track_markdown(content))
        return Verdict(f"{log}, {content['scene']}", title, f"{'; '.join(facts)}.", tables)
    if source.kind == "run":
        seeds = content["seeds"]
        curves = content["curves"].values()
        title = f"{len(seeds)} of {len(curves)} training seeds of {source.path} are finished"
        more = "; mmwave-loc train --resume continues the other seeds"
        tables = ""
        if seeds:
            about = "The best policy of each training seed, on tuning seeds"
            tables = element("p", about, "caption") + html_of(outcomes_markdown(seeds))
        for rival in dict.fromkeys(rival for curve in curves for rival in curve):
            lines = [curve[rival] for curve in curves if rival in curve]
            caption = f"Gain in reward over {rival} on tuning seeds, a line per training seed"
            label = f"reward minus reward of {rival}"
            tables += drawn(caption, draw_learning_curves, label, lines)
        sentence = f"{title}{'' if len(seeds) == len(curves) else more}."
        return Verdict(source.path, title, sentence, tables)
    comparison = Comparison.from_json(content)
    return _verdict(comparison, "".join(_compared(comparison, content.get("position_errors"))))


def _verdict(comparison: Comparison, tables: str) -> Verdict:
    """Return the verdict on the best contender and the next contender that is paired with it."""
    best, *others = comparison.policies
    name = f"{comparison.scenario}, {comparison.radio}, {named(comparison.seeds)}"
    title = f"{best} has a reward of {comparison.policies[best]['reward']}"
    for other in others:
        by = comparison.margin(best, other)
        if by:
            level = by.low <= 0.0
            title = f"{best} and {other} are level" if level else f"{best} beats {other} by {by}"
            break
    sentence = f"{title}, in rewards per epoch: {len(comparison.policies)} policies on {name}."
    return Verdict(name, title, sentence, tables)


def _compared(comparison: Comparison, positions: Json | None) -> Iterator[str]:
    _, _, tables = str(comparison).partition("\n\n")  # without their title
    yield html_of(tables)
    if positions:
        rows = positions["policies"]
        ranked = {name: rows[name] for name in comparison.policies if name in rows}
        about = "Errors in all episodes, without the first 10 epochs of each"
        yield element("p", about, "caption")
        kind = positions.get("levels", "gaussian")
        yield html_of(positions_markdown("policy", ranked, positions["risk"], kind))
    for name in comparison.policies:
        if name in DESCRIPTIONS:
            yield element("p", f"{name}: {DESCRIPTIONS[name]}", "caption")
    yield element("p", WORDS, "caption")


def origin_of(title: str, command: str, versions: Json) -> str:
    """Return HTML with the command and the package versions that made results or this page."""
    made = ", ".join(f"{name} {version}" for name, version in versions.items())
    parts = element("h3", title), element("pre", command)
    return "".join(parts) + (element("p", f"Made with {made}.") if versions else "")


LONGEST = 600  # maximum number of epochs of an episode that can be watched


@dataclass
class Played:
    """Results of contenders in episodes that were played again."""

    which: str = "no episodes"  # description of the episodes
    epochs: EpochErrors = field(default_factory=EpochErrors)  # of scored epochs
    axes: int = 3  # number of axes that the NEES covers
    shown: list[Json] = field(default_factory=list)  # episodes to watch, as JSON
    missing: list[str] = field(default_factory=list)  # notes on what was not played again


def play(source: Source, most: int, watched: int) -> Played:
    """Run the first episodes of a comparison, or the beginning of a log, again.

    A user's code is not run: contenders given as module:function or as a .zip file are left out.
    At most ``most`` episodes run; the page shows the first ``watched`` of these episodes.
    """
    if source.kind == "run":
        return Played()
    try:
        if source.kind == "track":
            return _play_log(source)
        if most:
            return _play_episodes(source, most, watched)
    except (ValueError, OSError) as error:
        return Played(missing=[f"no episode was played again: {error}"])
    return Played(missing=["no episode was played again: no episodes were asked for"])


def _play_episodes(source: Source, most: int, watched: int) -> Played:
    names = [*Comparison.from_json(source.content).policies]
    args = options_from(EpisodeArgs, source.content)
    args = replace(args, episodes=min(most, source.content["episodes"]))
    task = task_of(args)
    seeds = seeds_from(args.episodes, args.seed)
    scoring = Scoring.of(task)
    chosen = []
    missing = []
    for name in names:
        try:
            if is_agent(name):
                raise ValueError("it is a user's code, which is not run for a report")
            chosen.append(contender_of(args, name))
        except (ValueError, OSError) as error:
            missing.append(f"{name} was not played again: {error}")
    axes = 2 if scoring.planar else 3
    played = Played(named(seeds), axes=axes, missing=missing)
    score_contenders(chosen, task.source, seeds, watch=[played.epochs.add], scoring=scoring)
    some = seeds[:watched] if chosen else ()
    for seed, (episode, histories) in zip(some, histories_of(task, some, chosen), strict=True):
        name = f"{task.source.name}: {episode.name}, seed {seed}"
        courses = {}
        for contender, history in zip(chosen, histories, strict=True):
            part = history.part(slice(1, LONGEST + 1))  # without the prior
            courses[contender.name] = _course(part, contender.actions, contender.policy is None)
        played.shown.append(_episode(name, part, episode.layout.group_names, courses))
    return played


def _play_log(source: Source) -> Played:
    """Localize the first epochs of a log again."""
    block, work = beginning(options_from(LogArgs, source.content), LONGEST)
    known = work.truth_m(block.time_s)
    velocity = velocity_of(block.time_s, known, GAP_S)
    log = source.content["log"]
    scene = work.scene
    switching = work.choice.switching
    pipeline = switching.pipeline(block.layout, block.planar)
    belief = pipeline.belief([*block.x.T], [*block.P.T])
    history = History(
        log,
        scene.anchors_m,
        scene if scene.streets_known else None,
        len(belief.axes),
        time_s=block.time_s - block.time_s[0],
        modes=block.mode,
        truth=np.hstack([known, velocity]),
        estimate=block.x,
        P=block.P[:, :POSITION_NUMBERS],
        nees=np.asarray(belief.nees([*known.T])),
        accepted=block.accepted,
        rejected=block.visible & ~block.accepted,
    )
    course = _course(history, switching.names, switching.bank is not None)
    shown = _episode(log, history, block.layout.group_names, {"track": course})
    return Played(shown=[shown])


def errors_of(played: Played) -> Iterator[str]:
    """Yield HTML pictures of the errors in a comparison's episodes; nothing for other sources."""
    epochs = played.epochs
    if epochs.errors_m:
        caption = f"Distribution of errors (CDF), {played.which}"
        yield drawn(caption, draw_error_cdf, epochs.errors_m)
        caption = f"NEES and its chi-square bounds, {played.which}"
        nees = (epochs.time_s, epochs.nees, played.axes)
        yield drawn(caption, draw_consistency, *nees)


def _episode(name: str, history: History, groups: Sequence[str], courses: Json) -> Json:
    """Return an episode's data for the player.

    ``history`` is the history of any contender, since the truth is the same in all; ``groups`` are
    names of groups of measurements; ``courses`` are the results by contender.
    """
    truth = history.truth
    scene = history.scene
    streets = scene and scene.streets
    return {
        "name": printable(name),
        "time_s": _numbers(history.time_s),
        "x": _numbers(truth[:, 0]),
        "y": _numbers(truth[:, 1]),
        "speed_mps": _numbers(history.true_mps),
        "anchors": [_numbers(anchor) for anchor in history.anchors_m],
        "streets": streets and {"x": [*streets.x_m], "y": [*streets.y_m], "block": streets.block_m},
        "images": len(scene.walls) if scene else 0,
        "groups": ["gNB", *groups[1:]],
        "nees_bounds": [*nees_interval(history.axes)],
        "contenders": {printable(name): course for name, course in courses.items()},
    }


def _course(history: History, modes: Sequence[str], weighed: bool) -> Json:
    """Return the results of a contender in an episode, in the form that the player needs.

    If ``weighed``, the contender weights all modes, and "mode" contains the most probable mode of
    every epoch; otherwise, "mode" contains the chosen mode or action.
    """
    letters = history.fates.astype("U1")  # a: accepted, r: rejected, m: missing
    estimate = history.estimate
    major, minor, turn = axes_of(history.P)
    axes = (2.0 * major, 2.0 * minor, -np.degrees(turn))  # clockwise from the x axis
    themes = (THEMES[theme].for_modes(modes).modes for theme in ("light", "dark"))
    return {
        "x": _numbers(estimate[:, 0]),
        "y": _numbers(estimate[:, 1]),
        # ellipse of two standard deviations
        "ellipse": [_numbers(values, ".4g") for values in axes],
        "speed_mps": _numbers(history.speed_mps),
        "error_m": _numbers(history.error_m),
        "nees": _numbers(history.nees, ".4g"),
        "modes": [printable(name) for name in modes],
        "colors": [f"light-dark({hex_of(a)}, {hex_of(b)})" for a, b in zip(*themes, strict=True)],
        "mode": history.modes.tolist(),
        "weighed": weighed,
        "fate": ["".join(column) for column in letters.T],
    }


def _numbers(values: Array, digits: str = ".2f") -> list[float | None]:
    """Round numbers; replace NaN and infinite numbers by None."""
    return [float(f"{v:{digits}}") if np.isfinite(v) else None for v in values]


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
    titles = {re.sub(r"\W+", "-", t.lower()): t for t, section in sections.items() if section}
    # In JSON, the signs <, > and & are escaped, so that no text can end the script element.
    shown = {"episodes": [episode for part in played for episode in part.shown]}
    data = json.dumps(shown, allow_nan=False, separators=(",", ":"))
    light = vars(THEMES["light"])
    dark = vars(THEMES["dark"])
    colors = " ".join(  # as CSS variables; videos have the same
        f"--{name}: light-dark({hex_of(light[name])}, {hex_of(dark[name])});"
        for name in sorted(light.keys() - {"modes"})
    )
    parts = {
        "title": text(verdicts[0].title),
        "lead": "".join(element("p", verdict.sentence) for verdict in verdicts),
        "style": f":root {{ {colors} }}\n{_file('page.css')}",
        "script": "".join(map(_file, SCRIPTS)),
        "links": "".join(f'<a href="#{name}">{text(title)}</a>' for name, title in titles.items()),
        "sections": "".join(
            f'<section id="{name}"><h2>{text(title)}</h2>{sections[title]}</section>'
            for name, title in titles.items()
        ),
        "data": data.translate({ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&"}),
    }
    # Placeholders in inserted text are not replaced.
    return re.sub(r"<!--(\w+)-->", lambda mark: parts[mark[1]], _file("page.html"))


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
        parts += [element("p", f"{verdict.name}: {note}", "note") for note in source.missing]
    return "".join(parts)


def _file(name: str) -> str:
    return (files("experiments.reporting.webpage") / name).read_text(encoding="utf-8")
