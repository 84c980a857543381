"""Second runs of a comparison's episodes or of a log, for details that results do not store."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import chdtri

from experiments.console.options import EpisodeArgs, LogArgs
from experiments.console.provenance import options_from
from experiments.evaluation.agents import is_agent
from experiments.evaluation.asked import contender_of, runs_of, selection_of, task_of
from experiments.evaluation.contenders import Contender
from experiments.evaluation.histories import EpochErrors
from experiments.evaluation.positions import Positions
from experiments.evaluation.runner import EpochResults, Scoring, score_contenders
from experiments.reporting.log_results import beginning
from experiments.reporting.webpage.sources import Source
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.io.lookup import printable
from mmwave_env.localization.levels import Levels
from mmwave_env.metrics import nees_interval
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import Streets
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import GATE
from mmwave_env.rendering.theme import THEMES, hex_of

LONGEST = 600  # maximum number of epochs that can be watched
ROWS = slice(LONGEST)
WATCHED = 8  # maximum number of contenders to watch: the best by reward, and the paper's rule
RULE = "speed-rule"
AFTER = ("x", "P", "memory.nis", "memory.accepted", "memory.rejected", "memory.mode")


@dataclass
class Played:
    """Results of contenders in episodes that were played again."""

    which: str = "no episodes"  # description of the episodes
    # epochs, positions: errors, NEES and protection levels of the scored epochs
    epochs: EpochErrors = field(default_factory=lambda: EpochErrors({}))
    positions: Positions = field(default_factory=lambda: Positions({}))
    shown: list[dict[str, Any]] = field(default_factory=list)  # episodes to watch, as JSON
    # names of missing contenders, with the reasons; the name "" stands for all contenders
    missing: dict[str, str] = field(default_factory=dict)


def play(source: Source, most: int, watched: int) -> Played:
    """Run the first episodes of a comparison, or the beginning of a log, again.

    A user's code is not run: contenders that are a function in a module or a model in a zip file
    are left out. At most ``most`` episodes run; the first ``watched`` are kept epoch by epoch.
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
    names = ranking(source.content["policies"])
    alike = dict(zip(names, names, strict=True))
    args = options_from(EpisodeArgs, source.content)
    args = replace(args, episodes=min(most, source.content["episodes"]))
    task, selection, missing = task_of(args), selection_of(args), dict[str, str]()
    scoring, chosen = Scoring.of(task), _contenders(args, names, missing)
    axes, keys = 2 if scoring.planar else 3, selection.keys(task.source)
    shown = []
    for i, episode in enumerate(selection.draw(task.source)[:watched]):
        name = f"{task.source.name}: {episode.name}, seed {selection.seeds[i]}"
        streets = task.streets_of(0 if keys is None else int(keys[i]))
        assert episode.truth_position_m is not None and episode.truth_velocity_mps is not None
        speed_mps = np.linalg.norm(episode.truth_velocity_mps, axis=1)
        truth = np.column_stack([episode.time_s, episode.truth_position_m, speed_mps])
        anchors_m = episode.scene_anchors_m
        shown.append(_scenery(name, episode.layout, anchors_m, streets, axes, truth))
    levels = Levels(args.risk, args.levels)
    positions = Positions(alike, levels, task.source.layout.anchors, scoring.planar)
    played = Played(str(selection), EpochErrors(alike), positions, shown, missing)

    def keep(contender: Contender, _: Array, epochs: EpochResults) -> None:
        for i, episode in enumerate(shown if contender.name in watched_names(names) else []):
            results = {part: values[i] for part, values in epochs.items()}
            course = _course(results, contender.actions, contender.policy is None)
            episode["contenders"][printable(contender.name)] = course

    watch = [played.epochs.add, positions.add, keep]
    score_contenders(
        chosen, task.source, args.radio, selection, watch=watch, scoring=scoring, after=AFTER
    )
    return played


def _play_log(source: Source) -> Played:
    """Localize the first epochs of a log again."""
    block, work = beginning(options_from(LogArgs, source.content), LONGEST)
    axes = (0, 1) if block.planar else (0, 1, 2)
    known = velocity = np.full((len(block), 3), np.nan)
    if work.truth:
        known, velocity = work.truth.at(block.time_s)[:2]
    belief = Belief([*block.x.T], unpack([*block.P.T], VERTICAL if block.planar else ()), axes)
    results = {
        "x": block.x,
        "P": block.P,
        "error": block.x[:, :3] - known,
        "nees": np.asarray(belief.nees([*known.T])),
        "memory.mode": block.mode,
        "memory.nis": block.nis,
        "memory.accepted": block.accepted,
        "memory.rejected": block.visible & ~block.accepted,
    }
    truth = np.column_stack([block.time_s, known, np.linalg.norm(velocity, axis=1)])
    scene, log = work.scene, source.content["log"]
    streets = scene.streets if scene.streets_known else None
    shown = _scenery(log, block.layout, scene.anchors_m, streets, len(axes), truth)
    switching = work.choice.switching
    course = _course(results, switching.names, switching.bank is not None)
    shown["contenders"]["track"] = course
    return Played(shown=[shown])


def _contenders(args: EpisodeArgs, names: list[str], missing: dict[str, str]) -> list[Contender]:
    """Return the available contenders; put the reasons why others are missing into ``missing``."""
    available = []
    for name in names:
        try:
            if is_agent(name):
                raise ValueError("it is a user's code, which is not run for a report")
            run = runs_of(args, [name])
            file = run[name].policy if run else name
            available.append(replace(contender_of(args, file), name=name))
        except (ValueError, OSError) as error:
            missing[name] = str(error)
    return available


def ranking(policies: Mapping[str, Any]) -> list[str]:
    """Return the names of the contenders in results, best reward first."""
    return sorted(policies, key=lambda name: -policies[name]["reward"]["mean"])


def watched_names(ranked: Sequence[str]) -> list[str]:
    """Return the names of the contenders that can be watched, in the order of the ranking."""
    best = [name for name in ranked if name != RULE][: WATCHED - (RULE in ranked)]
    return [name for name in ranked if name in (*best, RULE)]


def _scenery(
    name: str, layout: Layout, anchors_m: Array, streets: Streets | None, axes: int, truth: Array
) -> dict[str, Any]:
    """Return an episode's data for the player, still without contenders.

    ``anchors_m`` (L, 3) begins with the base station; NEES covers ``axes`` axes; ``truth`` (T, 5)
    has time (s), x, y, z (m) and speed (m/s), NaN where unknown.
    """
    dof = [group.stop - group.start for group in layout.groups]
    grid = streets and {"x": [*streets.x_m], "y": [*streets.y_m], "block": streets.block_m}
    return {
        "name": printable(name),
        "cut": len(truth) > LONGEST,
        "time_s": _numbers(truth[:, 0] - truth[0, 0], ".2f"),
        "x": _numbers(truth[:, 1], ".2f"),
        "y": _numbers(truth[:, 2], ".2f"),
        "speed_mps": _numbers(truth[:, 4], ".2f"),
        "anchors": [_numbers(anchor, ".2f") for anchor in anchors_m],
        "streets": grid,
        "groups": ["gNB", *layout.group_names[1:]],
        "rows": dof,
        "limits": [float(chdtri(n, 1.0 - GATE)) for n in dof],
        "nees_bounds": [*nees_interval(axes)],
        "contenders": {},
    }


def _course(results: Mapping[str, Any], modes: Sequence[str], weighed: bool) -> dict[str, Any]:
    """Return the results of a contender in an episode, in the form that the player needs.

    ``results`` are those of :func:`~experiments.evaluation.runner.run_contender` on one episode:
    "x", "P", "error", "nees" and the parts in AFTER. ``weighed`` says that an IMM combined all
    modes by their probabilities; the mode of an epoch is then the most probable mode.
    """
    accepted, rejected = results["memory.accepted"] > 0.5, results["memory.rejected"] > 0.5
    letters = np.where(accepted, "a", np.where(rejected, "r", "m"))[ROWS]
    xx, xy, yy = results["P"][:, :3].T
    mean, spread = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    axes = [2.0 * np.sqrt(np.maximum(size, 0.0)) for size in (mean + spread, mean - spread)]
    turn = -0.5 * np.degrees(np.arctan2(2.0 * xy, xx - yy))  # clockwise from the x axis
    themes = (THEMES[theme].for_modes(modes).modes for theme in ("light", "dark"))
    return {
        "x": _numbers(results["x"][:, 0], ".2f"),
        "y": _numbers(results["x"][:, 1], ".2f"),
        # ellipse of two standard deviations
        "ellipse": [_numbers(values) for values in (*axes, turn)],
        "speed_mps": _numbers(np.linalg.norm(results["x"][:, 3:6], axis=1), ".2f"),
        "error_m": _numbers(np.linalg.norm(results["error"], axis=1), ".2f"),
        "nees": _numbers(results["nees"]),
        "modes": [printable(name) for name in modes],
        "colors": [f"light-dark({hex_of(a)}, {hex_of(b)})" for a, b in zip(*themes, strict=True)],
        "mode": results.get("mode", results["memory.mode"])[ROWS].astype(int).tolist(),
        "weighed": weighed,
        "fate": ["".join(column) for column in letters.T],
        "nis": [_numbers(group) for group in results["memory.nis"].T],
    }


def _numbers(values: Array, digits: str = ".4g") -> list[float | None]:
    """Round numbers; replace those that are not finite by None."""
    return [float(f"{v:{digits}}") if np.isfinite(v) else None for v in values[ROWS]]
