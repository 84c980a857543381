"""The web page as one file, made from a template, a style sheet, scripts and data.

First come parts of HTML; then the sources of results, with verdicts and tables.
Results files do not store single epochs, so the page plays some episodes, or a log, again.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from experiments.console.options import CompareArgs, LogArgs, PageArgs
from experiments.console.output import cells_of, unescaped
from experiments.console.provenance import options_from, provenance
from experiments.evaluation.agents import is_agent
from experiments.evaluation.compare import Comparison
from experiments.evaluation.contenders import DESCRIPTIONS, contender_of, named, seeds_from, task_of
from experiments.evaluation.positions import positions_markdown
from experiments.evaluation.runner import histories_of
from experiments.reporting.log_report import track_markdown
from experiments.reporting.log_results import beginning
from mmwave_env.io.files import Json, first_line, read_json
from mmwave_env.io.lookup import printable
from mmwave_env.logs.truth import velocity_of
from mmwave_env.metrics import nees_interval
from mmwave_env.models.prior import GAP_S
from mmwave_env.numerics.ellipses import axes_of
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import POSITION_NUMBERS, History
from mmwave_env.rendering.theme import THEMES, hex_of


def text(value: Any) -> str:
    """Escape text for HTML, including quoted attributes; spell out unprintable characters."""
    return escape(printable(str(value)))


def element(tag: str, words: Any, kind: str = "") -> str:
    """Return an HTML element that contains plain text."""
    return f"<{tag}{kind and f' class={kind}'}>{text(words)}</{tag}>"


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table of plain text that scrolls sideways; the first cell of a row names the row."""
    head = "".join(f'<th scope="col">{text(title)}</th>' for title in header)
    body = "".join(
        f'<tr><th scope="row">{text(name)}</th>{"".join(element("td", c) for c in cells)}</tr>'
        for name, *cells in rows
    )
    return (
        f'<div class="table" tabindex="0" role="region" aria-label="{text(header[0])}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
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


READ = "results (--json) of compare, demo or localize"


@dataclass
class Part:
    """The part of the page on one file of results.

    Attributes:
        content: content of the file.
        name: name of the results.
        title, sentence: outcome of the results, as a title and as a sentence.
        tables: HTML of tables.
        origin: HTML with the command and the versions that made the results.
        episodes: episodes to watch, as JSON.
        missing: notes on what was not played again.
    """

    content: Json
    name: str
    title: str
    sentence: str
    tables: str
    origin: str = ""
    episodes: list[Json] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def read_part(path: Path) -> Part:
    """Read a file of results; nothing is played again yet.

    Raises:
        ValueError: the file does not hold results; the message names the file and what it lacks.
        FileNotFoundError: there is no such file.
    """
    content = read_json(path, "results", dict)
    try:
        part = _track(content) if "groups" in content else _comparison(content)
        part.origin = origin_of(str(path), content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{path}: {first_line(error)}, expected {READ}") from error
    return part


WORDS = (
    "Wide tables scroll sideways. Means ± half the widths of their 95 % intervals, best reward "
    "first. reward (unless the title names another): per epoch, minus the position error in m, and"
    " minus a penalty if the filter misjudges its error. ATE: mean position error. RMSE: root of "
    "the mean square error. RPE: change of the error within a second. NEES: squared error relative"
    " to the filter's own covariance; 3 is right (2 on flat ground), more is too confident. "
    "diverged: share of episodes whose error exceeds 50 m at some time."
)


def _track(content: Json) -> Part:
    """Return the part on the track of a log."""
    log = content["log"]
    times = f"{content['first_s']:.13g} to {content['last_s']:.13g} s"
    title = f"{content['epochs']} epochs of {log}, {times}"
    facts = [title]
    for name, row in content.get("truth", {"tracks": {}})["tracks"].items():
        facts.append(f"the {name} track has an ATE of {row['ate_m']:.3f} m")
    if content.get("error"):
        facts.append(f"only part of the log was used: {content['error']}")
    tables = html_of(track_markdown(content))
    return Part(content, f"{log}, {content['scene']}", title, f"{'; '.join(facts)}.", tables)


def _comparison(content: Json) -> Part:
    """Return the part on a comparison.

    Its title is about the best contender and the next contender that is paired with it.
    """
    comparison = Comparison.from_json(content)
    best, *others = comparison.policies
    name = f"{comparison.scenario}, {comparison.radio}, {named(comparison.seeds)}"
    title = f"{best} has a reward of {comparison.policies[best]['reward']}"
    for other in others:
        if by := comparison.margin(best, other):
            level = round(by.low, 3) <= 0.0
            title = f"{best} and {other} are level" if level else f"{best} beats {other} by {by}"
            break
    sentence = f"{title}, in rewards per epoch: {len(comparison.policies)} policies on {name}."
    tables = "".join(_compared(comparison, content.get("position_errors")))
    return Part(content, name, title, sentence, tables)


def _compared(comparison: Comparison, positions: Json | None) -> Iterator[str]:
    _, _, tables = str(comparison).partition("\n\n")  # without their title
    yield html_of(tables)
    if positions:
        rows = positions["policies"]
        ranked = {name: rows[name] for name in comparison.policies if name in rows}
        yield element("p", "Errors in all episodes, without the first 10 epochs of each", "caption")
        kind = positions.get("levels", "gaussian")
        yield html_of(positions_markdown("policy", ranked, positions["risk"], kind))
    for name in comparison.policies:
        if name in DESCRIPTIONS:
            yield element("p", f"{name}: {DESCRIPTIONS[name]}", "note")
    yield element("p", WORDS, "note")


def origin_of(title: str, content: Json) -> str:
    """Return HTML with the command and the package versions that made results or this page."""
    made = ", ".join(f"{name} {version}" for name, version in content["versions"].items())
    command = element("pre", content["command"])
    return element("h3", title) + command + element("p", f"Made with {made}.")


LONGEST = 600  # maximum number of epochs of an episode that can be watched


def play(part: Part, episodes: int) -> None:
    """Run the first episodes of a comparison, or the beginning of a log, again.

    A user's code is not run: contenders given as module:function or as a .zip file are left out.
    """
    try:
        if "groups" in part.content:
            _play_log(part)
        elif episodes:
            _play_episodes(part, episodes)
        else:
            raise ValueError("no episodes were asked for")
    except (ValueError, OSError) as error:
        part.missing.append(f"no episode was played again: {error}")


def _refuse_own_code(name: str | None) -> None:
    if name and is_agent(name):
        raise ValueError("a user's code is not run for a report")


def _play_episodes(part: Part, episodes: int) -> None:
    args = options_from(CompareArgs, part.content)
    seeds = seeds_from(min(episodes, part.content["episodes"]), args.seed)
    task = task_of(args)
    chosen = []
    for name in Comparison.from_json(part.content).policies:
        try:
            _refuse_own_code(name)
            chosen.append(contender_of(args, name))
        except (ValueError, OSError) as error:
            part.missing.append(f"{name} was not played again: {error}")
    if not chosen:
        return
    for seed, (episode, histories) in zip(seeds, histories_of(task, seeds, chosen), strict=True):
        name = f"{task.source.name}: {episode.name}, seed {seed}"
        courses = {}
        for contender, history in zip(chosen, histories, strict=True):
            first = history.part(slice(1, LONGEST + 1))  # without the prior
            courses[contender.name] = _course(first, contender.actions, contender.policy is None)
        part.episodes.append(_episode(name, first, episode.layout.group_names, courses))


def _play_log(part: Part) -> None:
    """Localize the first epochs of a log again."""
    args = options_from(LogArgs, part.content)
    _refuse_own_code(args.policy)
    block, work = beginning(args, LONGEST)
    known = work.truth_m(block.time_s)
    velocity = velocity_of(block.time_s, known, GAP_S)
    log = part.content["log"]
    scene = work.scene
    switching = work.switching
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
    part.episodes.append(_episode(log, history, block.layout.group_names, {"track": course}))


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


def page_of(args: PageArgs) -> str:
    """Return the web page of results; refuse results that can't be read."""
    parts = [read_part(path) for path in args.results]
    for part in parts:
        play(part, args.episodes)
    origins = "".join(part.origin for part in parts)
    # In JSON, the signs <, > and & are escaped, so that no text can end the script element.
    shown = {"episodes": [episode for part in parts for episode in part.episodes]}
    data = json.dumps(shown, allow_nan=False, separators=(",", ":"))
    light = vars(THEMES["light"])
    dark = vars(THEMES["dark"])
    colors = (  # as CSS variables; videos have the same
        f"--{name}: light-dark({hex_of(light[name])}, {hex_of(dark[name])});"
        for name in sorted(light.keys() - {"modes"})
    )
    notes = [f"{part.name}: {note}" for part in parts for note in part.missing]
    inserted = {
        "title": text(parts[0].title),
        "lead": "".join(element("p", part.sentence) for part in parts),
        "colors": " ".join(colors),
        "results": _folded(parts),
        "notes": "".join(element("p", note, "note") for note in notes),
        "made": origins + origin_of("This page", provenance("report", args)),
        "data": data.translate({ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&"}),
    }

    def filled(mark: re.Match[str]) -> str:
        name = mark[1]
        return inserted[name] if name in inserted else _file(name)

    return re.sub(r"<!--([\w.]+)-->", filled, _file("page.html"))  # not in inserted text


def _folded(parts: Sequence[Part]) -> str:
    """Return the tables of all parts, which can be folded; only the first are open."""
    opening = "<details open>"
    folded = ""
    for part in parts:
        folded += f"{opening}<summary>{text(part.name)}</summary>{part.tables}</details>"
        opening = "<details>"
    return folded


def _file(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
