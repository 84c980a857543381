"""What the commands that run episodes have in common."""

import shlex
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from experiments.arguments.shared import EpisodeArgs, WorldArgs
from experiments.evaluation.contenders import Contender, contender_from, contenders
from experiments.evaluation.runs import Run
from mmwave_env.filters.mode_files import modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.task import Task, TaskArguments, task_from


def command_line(name: str, args: Any) -> str:
    """The command that a dataclass of arguments stands for, defaults left out."""
    nameless = [field.name for field in fields(args) if field.metadata.get("positional")]
    words = ["mmwave-loc", name, *(str(getattr(args, field)) for field in nameless)]
    for field in fields(args):
        value = getattr(args, field.name)
        if field.name not in nameless and value != field.default:
            values = value if isinstance(value, tuple) else () if value is True else (value,)
            words += [f"--{field.name.replace('_', '-')}", *map(str, values)]
    return shlex.join(words)


def all_contenders(args: EpisodeArgs) -> tuple[str, ...]:
    """Names of all there are for the modes asked for."""
    return tuple(contenders(args.radio, _modes(args)))


def contender_of(args: EpisodeArgs, name: str) -> Contender:
    """One of them, or an agent by name or file."""
    return contender_from(name, args.radio, _modes(args), args.observation, args.trust_zip)


def runs_of(args: EpisodeArgs, names: Sequence[str]) -> dict[str, Run]:
    """Those of the names that are folders of runs."""
    known = all_contenders(args)
    return {n: Run.read(n) for n in names if n not in known and Path(n).is_dir()}


def task_of(args: WorldArgs) -> Task:
    """The task of an environment with the options of the same names."""
    names = {field.name for field in fields(TaskArguments)} - {"episodes", "modes"}
    given = {name: value for name, value in vars(args).items() if name in names}
    return task_from(**given, episodes=args.data)


def _modes(args: EpisodeArgs) -> tuple[Mode, ...] | None:
    return modes_from(args.modes, args.radio) if args.modes else None
