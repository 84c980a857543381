"""Some episodes of a comparison, played again: what its file does not hold, epoch by epoch."""

import shlex
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field, replace
from io import StringIO
from typing import Any

import numpy as np

from experiments.console.main import read_arguments
from experiments.console.options import EpisodeArgs
from experiments.console.progress import tracked
from experiments.console.signals import Ended
from experiments.evaluation.agents import is_agent
from experiments.evaluation.asked import contender_of, selection_of, task_of
from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import EpochResults, Scoring, run_contender
from experiments.evaluation.seeds import Selection
from experiments.webpage.episodes import Gates, Place, course, scenery
from experiments.webpage.source import Source
from mmwave_env.datasets.samples import sample_names
from mmwave_env.localization.position_errors import PositionErrors
from mmwave_env.metrics import scored
from mmwave_env.numerics.arrays import Array
from mmwave_env.task import Task
from mmwave_env.world.episode import Episode

WATCHED = 8  # contenders that can be watched: the best by reward, and those in ALWAYS
ALWAYS = ("speed-rule",)
AFTER = ("x", "P", "memory.nis", "memory.accepted", "memory.rejected")


@dataclass
class Played:
    """What contenders did in some episodes of a comparison.

    Attributes:
        which: the episodes, in words.
        axes: position axes that NEES covers.
        errors_m: (n, T, 3) by contender, of the epochs that count, m.
        positions: the same by contender, with protection levels.
        nees: (n, T) by contender, of the same.
        shown: episodes to watch, as JSON holds them.
        missing: why there is nothing of a contender; of all of them under the name "".
    """

    which: str = "no episodes"
    axes: int = 3
    errors_m: dict[str, Array] = field(default_factory=dict)
    positions: dict[str, PositionErrors] = field(default_factory=dict)
    nees: dict[str, Array] = field(default_factory=dict)
    shown: list[dict[str, Any]] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)


def play(source: Source, episodes: int, watched: int) -> Played:
    """Play the first episodes of a comparison again, with all contenders that can be had.

    No code of others is run for it: contenders that are a function in a module or a model in a zip
    file are left out.

    Args:
        source: the comparison.
        episodes: how many, at most.
        watched: how many of them to keep epoch by epoch.
    """
    if not episodes:
        return Played(missing={"": "none were asked for"})
    try:
        args = _first(arguments_of(source), episodes, source.content["episodes"])
        task = task_of(args)
        scoring, selection = Scoring.of(task), selection_of(args, task.source)
        batch = selection.draw(task.source)
    except (ValueError, OSError) as error:
        return Played(missing={"": str(error)})
    shown = _sceneries(task, selection, batch[:watched])
    found = Played(str(selection), 2 if scoring.planar else 3, shown=shown)
    policies = source.content["policies"]
    watch, counted = watched_names(policies), scored(len(batch[0]))
    for name in tracked(policies, f"playing {batch[0].name}", len(policies)):
        try:
            contender = _contender(args, name)
            policy = contender.start(task.source.layout, scoring.planar)
        except (ValueError, OSError) as error:
            found.missing[name] = str(error)
            continue
        parts = AFTER if policy else (*AFTER, "mixture.probability")
        told = run_contender(contender, policy, batch, scoring, after=parts)
        found.errors_m[name], found.nees[name] = told["error"][:, counted], told["nees"][:, counted]
        found.positions[name] = PositionErrors(args.risk, scoring.planar)
        found.positions[name].add(found.errors_m[name], told["P"][:, counted])
        for i, one in enumerate(shown if name in watch else []):
            one["contenders"][name] = _course(contender, told, i)
    return found


def watched_names(policies: Mapping[str, Any]) -> list[str]:
    """Contenders that can be watched, best first by their reward in results."""
    ranked = sorted(policies, key=lambda name: -policies[name]["reward"]["mean"])
    first = [name for name in ALWAYS if name in policies]
    chosen = {*first, *[name for name in ranked if name not in first][: WATCHED - len(first)]}
    return [name for name in ranked if name in chosen]


def arguments_of(source: Source) -> Any:
    """The options of the command that made results.

    Raises:
        ValueError: this version does not understand it.
    """
    _, name, *words = shlex.split(source.command)
    if name in _WITHOUT_OPTIONS:
        return _WITHOUT_OPTIONS[name](source.content)
    complaint = StringIO()
    try:
        with redirect_stderr(complaint):
            return read_arguments(name, words)
    except Ended:  # a signal came meanwhile
        raise
    except SystemExit:
        raise ValueError(f"command: {complaint.getvalue().strip()}") from None


def _of_demo(content: Mapping[str, Any]) -> EpisodeArgs:
    scenario = content["scenario"]
    return EpisodeArgs(data=scenario if scenario in sample_names() else None)


def _of_learned(content: Mapping[str, Any]) -> EpisodeArgs:
    return EpisodeArgs(radio=content["radio"], seed=content["seed"])


# Commands whose options do not say which episodes they play: of what results say.
_WITHOUT_OPTIONS = {"demo": _of_demo, "learned": _of_learned}


def _first(args: EpisodeArgs, most: int, there: int) -> EpisodeArgs:
    """The same for no more episodes than that."""
    if args.keys is not None:
        return replace(args, keys=args.keys[:most])
    return replace(args, episodes=min(most, there))


def _contender(args: EpisodeArgs, name: str) -> Contender:
    if is_agent(name):
        raise ValueError("it is code of its own, which is not run for a report")
    return contender_of(args, name)


def _sceneries(
    task: Task, selection: Selection, episodes: Sequence[Episode]
) -> list[dict[str, Any]]:
    """The first episodes of a selection, without their contenders."""
    keys, axes = selection.keys(task.source), 2 if task.pipeline.planar else 3
    what, found = "key" if selection.keyed else "seed", []
    for i, (episode, number) in enumerate(zip(episodes, selection.numbers, strict=False)):
        assert episode.truth_position_m is not None and episode.truth_velocity_mps is not None
        speed = np.linalg.norm(episode.truth_velocity_mps, axis=1)
        streets = task.streets_of(0 if keys is None else int(keys[i]))
        place = Place(episode.scene_anchors_m, streets, episode.layout, axes)
        name = f"{episode.name}, {what} {number}"
        found.append(scenery(name, place, episode.time_s, episode.truth_position_m, speed))
    return found


def _course(contender: Contender, told: EpochResults, i: int) -> dict[str, Any]:
    """What a contender did in an episode."""
    weighed = "mode" not in told
    if weighed:
        modes = [one.name for one in contender.modes]
        mode = told["mixture.probability"][i].argmax(axis=1)
    else:
        modes, mode = contender.actions, told["mode"][i]
    gates = Gates(told["memory.accepted"][i], told["memory.rejected"][i], told["memory.nis"][i])
    belief = told["x"][i], told["P"][i], told["error"][i], told["nees"][i]
    return course(*belief, gates, modes, mode, weighed)
