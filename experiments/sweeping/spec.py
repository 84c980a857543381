"""What a sweep is to do: a TOML file of lists, every combination of which is a cell."""

import hashlib
import itertools
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

from experiments.arguments.shared import USUAL_EPISODES, EpisodeArgs, ModeArgs
from experiments.arguments.train import TaskArgs
from experiments.evaluation.seeds import TRAINING_SEED
from experiments.training.hyperparameters import KINDS as RECIPES
from mmwave_env import __version__
from mmwave_env.files import read_text
from mmwave_env.lookup import as_name, choose, quoted
from mmwave_env.records import require_fields

HYPERPARAMETER = "hyperparameters."  # begins the name of an axis of a training
JUDGED = 200  # episodes that a trained policy is judged on, where none are given
_EVALUATED = {f.name for f in fields(ModeArgs)} - {"trust_zip"} | {"episodes", "seed", "reward"}
_TRAINED = {f.name for f in fields(TaskArgs)} | {"total_timesteps"}
KINDS: Mapping[str, tuple[frozenset[str], frozenset[str]]] = {  # axes needed, axes known
    "evaluate": (frozenset({"policy"}), frozenset({"policy", *_EVALUATED})),
    "train": (frozenset({"total_timesteps"}), frozenset({"seed", "episodes", *_TRAINED})),
}
_LISTS = frozenset({"modes", "places"})  # values that are lists themselves


@dataclass(frozen=True)
class Cell:
    """One combination: the least that is computed, kept and computed again.

    Attributes:
        kind: "evaluate" or "train".
        values: by axis, sorted by name.
    """

    kind: str
    values: tuple[tuple[str, Any], ...]

    @property
    def name(self) -> str:
        """Of what it is to compute, and so of the file that holds it."""
        content = json.dumps([self.kind, self.values])
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def __str__(self) -> str:
        return f"{self.kind} {', '.join(f'{axis} {value}' for axis, value in self.values)}"


@dataclass(frozen=True)
class Spec:
    """A sweep.

    Attributes:
        name: of its file.
        cells: all that is to do, each once.
    """

    name: str
    cells: tuple[Cell, ...]

    @property
    def axes(self) -> list[str]:
        """Names of all axes."""
        return sorted({axis for cell in self.cells for axis, _ in cell.values})

    @property
    def run(self) -> str:
        """The name of its partition: another sweep, or version of the program, has another."""
        told = json.dumps([__version__, sorted(cell.name for cell in self.cells)])
        return f"{self.name}-{hashlib.sha256(told.encode()).hexdigest()[:8]}"


def read_spec(path: Path) -> Spec:
    """The sweep of a TOML file.

    A table ``[evaluate]`` has the options of ``mmwave-loc compare`` and ``policy``; a table
    ``[train]`` those of ``mmwave-loc train``, the ``seed`` of the training, ``episodes`` to judge
    it on, and a table ``[train.hyperparameters]``. A list is an axis, anything else a constant;
    ``modes`` and ``places`` are lists themselves, so that an axis of them is a list of lists.

    Raises:
        ValueError: naming the file, the key, what was found and what was expected.
        FileNotFoundError: there is no such file.
    """
    text = read_text(path, "a sweep, TOML")
    try:
        content = _toml().loads(text)
        cells = tuple(_cells(content))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a sweep: {error} (docs/sweep.md)") from error
    return Spec(as_name(path.stem), cells)


def _toml() -> Any:
    return import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")


def _cells(content: Mapping[str, Any]) -> Iterator[Cell]:
    if not content:
        raise ValueError(f"found nothing, expected a table [{'] or ['.join(KINDS)}]")
    seen = set[Cell]()
    for kind, table in content.items():
        needed, known = choose(KINDS, kind, "table")
        if not isinstance(table, dict):
            raise ValueError(f"{kind}: found {table!r}, expected a table")
        axes = dict(_axes(kind, table, known))
        for axis in needed - set(axes):
            raise ValueError(f"{kind}.{axis}: found none, expected one")
        for values in itertools.product(*axes.values()):
            cell = Cell(kind, tuple(sorted(zip(axes, values, strict=True))))
            _require_sound(cell)
            if cell in seen:
                raise ValueError(f"{kind}: found {cell} twice, expected each combination once")
            seen.add(cell)
            yield cell
        if kind == "evaluate":
            _require_apart(axes)


def _require_apart(axes: Mapping[str, Sequence[Any]]) -> None:
    """Refuse first seeds so near to each other that episodes would count twice."""
    least = max(axes.get("episodes", [USUAL_EPISODES]))
    for one, other in pairwise(sorted(axes.get("seed", []))):
        if other - one < least:
            raise ValueError(
                f"evaluate.seed: found {one} and {other}, expected first seeds {least} apart, the "
                "episodes of a cell: others would count twice"
            )


def _axes(
    kind: str, table: Mapping[str, Any], known: frozenset[str]
) -> Iterator[tuple[str, Sequence[Any]]]:
    """Names of axes and their values."""
    for key, value in table.items():
        if kind == "train" and key == HYPERPARAMETER[:-1] and isinstance(value, dict):
            yield from ((HYPERPARAMETER + name, _values(name, one)) for name, one in value.items())
        else:
            choose(dict.fromkeys(known), key, f"{kind}: key")
            yield key, _values(key, value)


def _values(key: str, value: Any) -> Sequence[Any]:
    """The values of an axis; lists within it as tuples, which cells can hold."""
    several = isinstance(value, list) and (
        key not in _LISTS or all(isinstance(one, list) for one in value)
    )
    values = [tuple(v) if isinstance(v, list) else v for v in (value if several else [value])]
    if not values:
        raise ValueError(f"{key}: found an empty list, expected values")
    for one in values:
        if any(isinstance(v, (dict, list)) for v in (one if isinstance(one, tuple) else [one])):
            raise ValueError(
                f"{key}: found {quoted(one)}, expected words, numbers or a list of them"
            )
    return values


def _require_sound(cell: Cell) -> None:
    """Refuse values of another type than the options they are, and training on test seeds."""
    values = dict(cell.values)
    try:
        episode_args(values) if cell.kind == "evaluate" else require_fields(task_args(values))
        for name in ("seed", "episodes", "total_timesteps"):
            found = values.get(name, 1)
            if type(found) is not int or found < (name != "seed"):
                raise ValueError(f"{name}: found {found!r}, expected a whole number")
        if cell.kind == "train" and values.get("seed", 0) >= TRAINING_SEED:
            raise ValueError(f"seed: found {values['seed']}, expected the number of a training")
        if cell.kind == "train":
            recipe = dict.fromkeys(
                field.name for field in fields(RECIPES[values.get("algo", "ppo")])
            )
            for axis in values:
                if axis.startswith(HYPERPARAMETER):
                    choose(recipe, axis.removeprefix(HYPERPARAMETER), HYPERPARAMETER[:-1])
    except ValueError as error:
        raise ValueError(f"{cell.kind}.{error}") from error


def episode_args(values: Mapping[str, Any]) -> EpisodeArgs:
    """The options of compare that a cell is about."""
    args = EpisodeArgs(**{name: value for name, value in values.items() if name != "policy"})
    require_fields(args)
    return args


def task_args(values: Mapping[str, Any]) -> TaskArgs:
    """The options of train that a cell is about."""
    known = {field.name for field in fields(TaskArgs)}
    return TaskArgs(**{name: value for name, value in values.items() if name in known})
