"""Replay of a comparison's episodes, or of a log, for details that results files do not store."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from experiments.console.options import EpisodeArgs, LogArgs
from experiments.console.provenance import options_from
from experiments.evaluation.agents import is_agent
from experiments.evaluation.compare import Comparison
from experiments.evaluation.contenders import Contender, contender_of, task_of
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.seeds import draw_episodes, keys_for, named, seeds_from
from experiments.reporting.figures.canvas import PHONE_MM
from experiments.reporting.figures.curves import draw_consistency, draw_error_cdf
from experiments.reporting.histories import EpochErrors, history_of
from experiments.reporting.log_results import beginning
from experiments.reporting.webpage.contents import Source
from experiments.reporting.webpage.markup import drawn
from mmwave_env.io.files import Json
from mmwave_env.io.lookup import printable
from mmwave_env.logs.truth import velocity_of
from mmwave_env.metrics import nees_interval
from mmwave_env.models.prior import GAP_S
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import POSITION_NUMBERS, History
from mmwave_env.rendering.theme import THEMES, hex_of

LONGEST = 600  # maximum number of epochs of an episode that can be watched
WATCHED = 8  # maximum number of contenders to watch: the best by reward, and the paper's rule
RULE = "speed-rule"


@dataclass
class Played:
    """Results of contenders in episodes that were played again."""

    which: str = "no episodes"  # description of the episodes
    epochs: EpochErrors = field(default_factory=lambda: EpochErrors(()))  # of scored epochs
    axes: int = 3  # number of axes that the NEES covers
    shown: list[Json] = field(default_factory=list)  # episodes to watch, as JSON
    # name of a missing contender -> reason; the name "" stands for all contenders
    missing: dict[str, str] = field(default_factory=dict)


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
        return Played(missing={"": str(error)})
    return Played(missing={"": "no episodes were asked for"})


def _play_episodes(source: Source, most: int, watched: int) -> Played:
    names = [*Comparison.from_json(source.content).policies]
    args = options_from(EpisodeArgs, source.content)
    args = replace(args, episodes=min(most, source.content["episodes"]))
    task = task_of(args)
    seeds = seeds_from(args.episodes, args.seed)
    missing = dict[str, str]()
    scoring = Scoring.of(task)
    chosen = _contenders(args, names, missing)
    axes = 2 if scoring.planar else 3
    played = Played(named(seeds), EpochErrors(names), axes, missing=missing)
    score_contenders(chosen, task.source, seeds, watch=[played.epochs.add], scoring=scoring)
    watchable = [contender for contender in chosen if contender.name in watched_names(names)]
    keys = keys_for(task.source, seeds)
    rows = slice(1, LONGEST + 1)  # without the prior
    for i, episode in enumerate(draw_episodes(task.source, seeds)[: watched if watchable else 0]):
        streets = task.streets_of(0 if keys is None else int(keys[i]))
        histories = [history_of(c, episode, scoring, streets).part(rows) for c in watchable]
        name = f"{task.source.name}: {episode.name}, seed {seeds[i]}"
        shown = _episode(name, histories[0], episode.layout.group_names)
        for contender, history in zip(watchable, histories, strict=True):
            course = _course(history, contender.actions, contender.policy is None)
            shown["contenders"][printable(contender.name)] = course
        played.shown.append(shown)
    return played


def _play_log(source: Source) -> Played:
    """Localize the first epochs of a log again."""
    block, work = beginning(options_from(LogArgs, source.content), LONGEST)
    known = np.full((len(block), 3), np.nan)
    if work.truth:
        known = work.truth.at(block.time_s)
    velocity = velocity_of(block.time_s, known, GAP_S)
    log = source.content["log"]
    scene = work.scene
    switching = work.choice.switching
    pipeline = switching.pipeline(block.layout, block.planar)
    belief = pipeline.belief([*block.x.T], [*block.P.T])
    history = History(
        log,
        scene.anchors_m,
        scene.streets if scene.streets_known else None,
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
    shown = _episode(log, history, block.layout.group_names)
    weighed = switching.bank is not None
    shown["contenders"]["track"] = _course(history, switching.names, weighed)
    return Played(shown=[shown])


def _contenders(args: EpisodeArgs, names: list[str], missing: dict[str, str]) -> list[Contender]:
    """Return the available contenders; put the reasons why others are missing into ``missing``."""
    available = []
    for name in names:
        try:
            if is_agent(name):
                raise ValueError("it is a user's code, which is not run for a report")
            available.append(contender_of(args, name))
        except (ValueError, OSError) as error:
            missing[name] = str(error)
    return available


def errors_of(played: Played) -> Iterator[str]:
    """Yield HTML pictures of the errors in a comparison's episodes; nothing for other sources."""
    epochs = played.epochs
    shown = watched_names([*epochs.errors_m])
    if shown:
        errors_m = {name: epochs.errors_m[name] for name in shown}
        draw = partial(draw_error_cdf, errors_m, width_mm=PHONE_MM)
        yield drawn(f"Distribution of errors (CDF), {played.which}", draw)
        nees = {name: epochs.nees[name] for name in shown}
        draw = partial(draw_consistency, epochs.time_s, nees, played.axes, width_mm=PHONE_MM)
        yield drawn(f"NEES and its chi-square bounds, {played.which}", draw)


def watched_names(ranked: Sequence[str]) -> list[str]:
    """Return the names of the contenders that can be watched, in the order of the ranking."""
    best = [name for name in ranked if name != RULE][: WATCHED - (RULE in ranked)]
    return [name for name in ranked if name in (*best, RULE)]


def _episode(name: str, history: History, groups: Sequence[str]) -> Json:
    """Return an episode's data for the player, still without contenders.

    ``history`` is the history of any contender, since the truth is the same in all; ``groups`` are
    names of groups of measurements.
    """
    truth = history.truth
    streets = history.streets
    return {
        "name": printable(name),
        "time_s": _numbers(history.time_s),
        "x": _numbers(truth[:, 0]),
        "y": _numbers(truth[:, 1]),
        "speed_mps": _numbers(history.true_mps),
        "anchors": [_numbers(anchor) for anchor in history.anchors_m],
        "streets": streets and {"x": [*streets.x_m], "y": [*streets.y_m], "block": streets.block_m},
        "groups": ["gNB", *groups[1:]],
        "nees_bounds": [*nees_interval(history.axes)],
        "contenders": {},
    }


def _course(history: History, modes: Sequence[str], weighed: bool) -> Json:
    """Return the results of a contender in an episode, in the form that the player needs.

    If ``weighed``, the contender weights all modes, and "mode" contains the most probable mode of
    every epoch; otherwise, "mode" contains the chosen mode or action.
    """
    letters = np.where(history.accepted, "a", np.where(history.rejected, "r", "m"))  # m: missing
    estimate = history.estimate
    xx, xy, yy = history.P[:, :3].T
    mean = (xx + yy) / 2.0
    spread = np.hypot((xx - yy) / 2.0, xy)
    axes = [2.0 * np.sqrt(np.maximum(size, 0.0)) for size in (mean + spread, mean - spread)]
    turn = -0.5 * np.degrees(np.arctan2(2.0 * xy, xx - yy))  # clockwise from the x axis
    themes = (THEMES[theme].for_modes(modes).modes for theme in ("light", "dark"))
    return {
        "x": _numbers(estimate[:, 0]),
        "y": _numbers(estimate[:, 1]),
        # ellipse of two standard deviations
        "ellipse": [_numbers(values, ".4g") for values in (*axes, turn)],
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
