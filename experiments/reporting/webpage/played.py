"""Replay of some episodes of a comparison, for details that its file does not hold."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field, replace
from io import StringIO
from typing import Any

import numpy as np
from scipy.special import chdtri

from experiments.console.main import read_arguments
from experiments.console.options import EpisodeArgs
from experiments.console.signals import Ended
from experiments.evaluation.agents import is_agent
from experiments.evaluation.asked import contender_of, runs_of, selection_of, task_of
from experiments.evaluation.contenders import Contender
from experiments.evaluation.histories import EpochErrors
from experiments.evaluation.positions import Positions
from experiments.evaluation.runner import EpochResults, Scoring, score_contenders
from experiments.reporting.webpage.sources import Source
from mmwave_env.datasets.samples import sample_names
from mmwave_env.io.lookup import printable
from mmwave_env.metrics import nees_interval
from mmwave_env.models.measurement import Layout
from mmwave_env.models.scene import Streets
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import GATE
from mmwave_env.rendering.theme import THEMES, hex_of

LONGEST = 600  # most epochs that can be watched
ROWS = slice(LONGEST)
WATCHED = 8  # most contenders to watch: the best by reward, and the rule
RULE = "speed-rule"
MADE_BY = {"comparison": ("compare", "evaluate", "demo"), "track": ("localize",)}
AFTER = ("x", "P", "memory.nis", "memory.accepted", "memory.rejected", "memory.mode")


@dataclass
class Played:
    """Results of contenders in episodes that were played again.

    Attributes:
        which: description of the episodes.
        epochs, positions: errors, NEES and protection levels of the scored epochs.
        shown: episodes to watch, as JSON holds them.
        missing: reason why a contender is missing; under the name "" why all are.
    """

    which: str = "no episodes"
    epochs: EpochErrors = field(default_factory=lambda: EpochErrors({}))
    positions: Positions = field(default_factory=lambda: Positions({}))
    shown: list[dict[str, Any]] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)


def play(source: Source, most: int, watched: int) -> Played:
    """Play the first episodes of a comparison again, with all contenders that are available.

    A user's code is not run: contenders that are a function in a module or a model in a zip file
    are left out.

    Args:
        source: comparison to play again.
        most: most episodes to play.
        watched: number of episodes to keep epoch by epoch.
    """
    if not most:
        return Played(missing={"": "none were asked for"})
    found, names = Played(), ranking(source.content["policies"])
    try:
        args = arguments_of(source)
        args = replace(args, episodes=min(most, source.content["episodes"]))
        task = task_of(args)
        scoring, chosen = Scoring.of(task), _contenders(args, names, found.missing)
        selection = selection_of(args)
        batch = selection.draw(task.source)[:watched]
    except (ValueError, OSError) as error:
        return Played(missing={"": str(error)})
    alike = {name: name for name in names}
    found.which, found.epochs = str(selection), EpochErrors(alike)
    found.positions = Positions(alike, args.risk, scoring.planar)
    keys = selection.keys(task.source)
    for i, (one, seed) in enumerate(zip(batch, selection.seeds, strict=False)):
        name = f"{task.source.name}: {one.name}, seed {seed}"
        streets = task.streets_of(0 if keys is None else int(keys[i]))
        assert one.truth_position_m is not None and one.truth_velocity_mps is not None
        speed_mps = np.linalg.norm(one.truth_velocity_mps, axis=1)
        truth = np.column_stack([one.time_s, one.truth_position_m, speed_mps])
        axes = 2 if scoring.planar else 3
        found.shown.append(scenery(name, one.layout, one.scene_anchors_m, streets, axes, truth))

    def keep(contender: Contender, _: Array, told: EpochResults) -> None:
        for i, one in enumerate(found.shown if contender.name in watched_names(names) else []):
            parts = {part: rows[i] for part, rows in told.items()}
            weighed = contender.policy is None
            one["contenders"][printable(contender.name)] = course(parts, contender.actions, weighed)

    what, watch = (task.source, args.radio, selection), [found.epochs.add, found.positions.add]
    score_contenders(chosen, *what, watch=[*watch, keep], scoring=scoring, after=AFTER)
    return found


def _contenders(args: EpisodeArgs, names: list[str], missing: dict[str, str]) -> list[Contender]:
    """Return available contenders, and put reasons into ``missing`` for the others."""
    found = []
    for name in names:
        try:
            if is_agent(name):
                raise ValueError("it is code of its own, which is not run for a report")
            run = runs_of(args, [name])
            file = run[name].policy if run else name
            found.append(replace(contender_of(args, file), name=name))
        except (ValueError, OSError) as error:
            missing[name] = str(error)
    return found


def ranking(policies: Mapping[str, Any]) -> list[str]:
    """Return the contenders of results, best reward first."""
    return sorted(policies, key=lambda name: -policies[name]["reward"]["mean"])


def watched_names(ranked: Sequence[str]) -> list[str]:
    """Return the contenders that can be watched, in the order of the ranking."""
    best = [name for name in ranked if name != RULE][: WATCHED - (RULE in ranked)]
    return [name for name in ranked if name == RULE or name in best]


def arguments_of(source: Source) -> Any:
    """Parse the options of the command that made results.

    Raises:
        ValueError: this version does not understand the command.
    """
    _, name, *words = shlex.split(str(source.content["command"]))
    if name not in (known := MADE_BY[source.kind]):
        raise ValueError(f"command: found {name}, expected one of {', '.join(known)}")
    if name == "demo":  # the options of demo do not say which episodes it plays
        scenario = source.content["scenario"]
        return EpisodeArgs(data=scenario if scenario in sample_names() else None)
    complaint = StringIO()
    try:
        with redirect_stderr(complaint):
            return read_arguments(name, words)
    except Ended:  # a signal came meanwhile
        raise
    except SystemExit:
        raise ValueError(f"command: {complaint.getvalue().strip()}") from None


# --- episodes to watch, as data of the script


def scenery(
    name: str, layout: Layout, anchors_m: Array, streets: Streets | None, axes: int, truth: Array
) -> dict[str, Any]:
    """Return an episode without its contenders.

    Args:
        name: name of the episode.
        layout: layout of the measurements.
        anchors_m: (L, 3) positions of anchors, the base station first.
        streets: streets to draw; None where they are unknown.
        axes: position axes that NEES covers.
        truth: (T, 5) time (s), x, y, z (m) and speed (m/s); NaN where unknown.
    """
    dof = [group.stop - group.start for group in layout.groups]
    grid = streets and {"x": [*streets.x_m], "y": [*streets.y_m], "block": streets.block_m}
    return {
        "name": printable(name),
        "cut": len(truth) > LONGEST,
        "time_s": numbers(truth[:, 0] - truth[0, 0], ".2f"),
        "x": numbers(truth[:, 1], ".2f"),
        "y": numbers(truth[:, 2], ".2f"),
        "speed_mps": numbers(truth[:, 4], ".2f"),
        "anchors": [numbers(one, ".2f") for one in anchors_m],
        "streets": grid,
        "groups": ["gNB", *layout.group_names[1:]],
        "rows": dof,
        "limits": [float(chdtri(n, 1.0 - GATE)) for n in dof],
        "nees_bounds": [*nees_interval(axes)],
        "contenders": {},
    }


def course(told: Mapping[str, Any], modes: Sequence[str], weighed: bool) -> dict[str, Any]:
    """Return the results of a contender in an episode, as the player needs them.

    Args:
        told: results of :func:`~experiments.evaluation.runner.run_contender` on one episode:
            "x", "P", "error", "nees" and the parts in AFTER.
        modes: names of the contender's modes.
        weighed: whether modes are mixed, so that "mode" is only the most probable mode.
    """
    accepted, rejected = told["memory.accepted"] > 0.5, told["memory.rejected"] > 0.5
    letters = np.where(accepted, "a", np.where(rejected, "r", "m"))[ROWS]
    xx, xy, yy = told["P"][:, :3].T
    mean, spread = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    axes = [2.0 * np.sqrt(np.maximum(size, 0.0)) for size in (mean + spread, mean - spread)]
    turn = -0.5 * np.degrees(np.arctan2(2.0 * xy, xx - yy))  # clockwise from the x axis
    themes = (THEMES[theme].for_modes(modes).modes for theme in ("light", "dark"))
    return {
        "x": numbers(told["x"][:, 0], ".2f"),
        "y": numbers(told["x"][:, 1], ".2f"),
        "ellipse": [numbers(one) for one in (*axes, turn)],  # ellipse of two standard deviations
        "speed_mps": numbers(np.linalg.norm(told["x"][:, 3:6], axis=1), ".2f"),
        "error_m": numbers(np.linalg.norm(told["error"], axis=1), ".2f"),
        "nees": numbers(told["nees"]),
        "modes": [printable(name) for name in modes],
        "colors": [f"light-dark({hex_of(a)}, {hex_of(b)})" for a, b in zip(*themes, strict=True)],
        "mode": told.get("mode", told["memory.mode"])[ROWS].astype(int).tolist(),
        "weighed": weighed,
        "fate": ["".join(column) for column in letters.T],
        "nis": [numbers(group) for group in told["memory.nis"].T],
    }


def numbers(values: Array, digits: str = ".4g") -> list[float | None]:
    """Round numbers; replace those that are not finite by None."""
    return [float(f"{v:{digits}}") if np.isfinite(v) else None for v in values[ROWS]]
