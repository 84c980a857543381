"""The web page as one file, made from a template, a style sheet, scripts and data.

Results files do not store single epochs, so the page plays some episodes, or a log, again.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files

import numpy as np

from experiments.console.options import EpisodeArgs, LogArgs, PageArgs
from experiments.console.provenance import command_line, options_from
from experiments.evaluation.agents import is_agent
from experiments.evaluation.compare import Comparison
from experiments.evaluation.contenders import contender_of, named, seeds_from, task_of
from experiments.evaluation.positions import EpochErrors
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.reporting.figures import draw_consistency, draw_error_cdf
from experiments.reporting.histories import histories_of
from experiments.reporting.log_results import beginning
from experiments.reporting.webpage.contents import (
    READ,
    Source,
    Verdict,
    drawn,
    element,
    origin_of,
    read_source,
    text,
    verdict_on,
)
from mmwave_env.io.files import Json, first_line
from mmwave_env.io.lookup import printable
from mmwave_env.logs.truth import velocity_of
from mmwave_env.metrics import nees_interval
from mmwave_env.models.prior import GAP_S
from mmwave_env.numerics.ellipses import axes_of
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import POSITION_NUMBERS, History
from mmwave_env.rendering.theme import THEMES, hex_of

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
