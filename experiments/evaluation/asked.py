"""Tasks, contenders (policies and IMMs) and episodes that the options of a command describe."""

import warnings
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from experiments.console.options import EpisodeArgs, ModeArgs, WorldArgs
from experiments.evaluation.contenders import Contender, contender_from, contenders
from experiments.evaluation.runs import Run
from mmwave_env.filters.bank import Modes, bank_over
from mmwave_env.filters.modes import Mode
from mmwave_env.task import Task, TaskArguments, task_from
from mmwave_env.world.episode import EpisodeSource


def all_contenders(args: ModeArgs) -> tuple[str, ...]:
    """Return the names of all contenders for the chosen modes."""
    return tuple(contenders(args.radio, args.modes or None))


def contender_of(args: ModeArgs, name: str) -> Contender:
    """Return a contender by name or file; warn if it ignores the chosen modes."""
    radio = args.radio
    modes = args.modes or None
    contender = contender_from(name, radio, modes, args.observation, args.beliefs)
    if modes and contender.modes != bank_over(modes, radio).modes:
        warnings.warn(f"{name} brings its own modes; --modes does not apply to it", stacklevel=2)
    return contender


def runs_of(args: EpisodeArgs, names: Sequence[str]) -> dict[str, Run]:
    """Read the training runs whose folders are among the names; skip known contenders."""
    known = all_contenders(args)
    return {n: Run.read(n) for n in names if n not in known and Path(n).is_dir()}


def task_of(args: ModeArgs) -> Task:
    """Return the task of an environment that gets these options as its arguments."""
    return _task(args, args.modes or None, args.beliefs)


def source_of(args: WorldArgs) -> EpisodeSource:
    """Return the source of the episodes that options describe."""
    # Filters do not matter here; a dummy mode avoids the warning about untuned modes.
    return _task(args, [Mode("none")]).source


def _task(args: WorldArgs, modes: Modes, beliefs: str = "shared") -> Task:
    names = {field.name for field in fields(TaskArguments)} - {"episodes", "modes", "beliefs"}
    world = {name: value for name, value in vars(args).items() if name in names}
    return task_from(**world, episodes=args.data, modes=modes, beliefs=beliefs)
