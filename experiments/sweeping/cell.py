"""A cell of a sweep: one evaluation or training, and what its values have to be."""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, get_type_hints

from experiments.console.options import EpisodeArgs, ModeArgs, TaskArgs
from experiments.evaluation.seeds import TRAINING_SEED
from experiments.training.hyperparameters import KINDS as HYPERPARAMETERS
from mmwave_env.lookup import choose, quoted
from mmwave_env.records import require_fields
from mmwave_env.reward import reward_from

HYPERPARAMETER = "hyperparameters."  # begins the name of an axis of a training
JUDGED = 200  # episodes that a trained policy is judged on, where none are given
_EVALUATED = {f.name for f in fields(ModeArgs)} - {"trust_zip"} | {"episodes", "seed", "reward"}
_TRAINED = {f.name for f in fields(TaskArgs)} | {"total_timesteps"}
KINDS: Mapping[str, tuple[frozenset[str], frozenset[str]]] = {  # axes needed, axes known
    "evaluate": (frozenset({"policy"}), frozenset({"policy", *_EVALUATED})),
    "train": (frozenset({"total_timesteps"}), frozenset({"seed", "episodes", *_TRAINED})),
}
_SEEDS = 1 << 62  # beyond it, seeds do not fit into their column
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


Result = dict[str, Any]
Compute = Callable[[Cell], Result]


class Done(NamedTuple):
    """A cell that is over."""

    cell: Cell
    result: Result | None  # of the cell; None where it failed
    error: str  # of the last try


def values_of(key: str, value: Any) -> Sequence[Any]:
    """The values of an axis; lists within it as tuples, which cells can hold."""
    several = isinstance(value, list) and (
        key not in _LISTS or all(isinstance(one, list) for one in value)
    )
    values = [tuple(v) if isinstance(v, list) else v for v in (value if several else [value])]
    if not values:
        raise ValueError(f"{key}: found an empty list, expected values")
    for one in values:
        if not all(_is_plain(v) for v in (one if isinstance(one, tuple) else [one])):
            raise ValueError(
                f"{key}: found {quoted(one)}, expected words, finite numbers or a list of them"
            )
    return values


def _is_plain(value: Any) -> bool:
    return isinstance(value, (str, int)) or (isinstance(value, float) and math.isfinite(value))


def require_sound(cell: Cell) -> None:
    """Refuse values of another type than the options they are, and training on test seeds."""
    values = dict(cell.values)
    try:
        episode_args(values) if cell.kind == "evaluate" else require_fields(task_args(values))
        for name in ("seed", "episodes", "total_timesteps"):
            found = values.get(name, 1)
            if type(found) is not int or not (name != "seed") <= found < _SEEDS:
                raise ValueError(f"{name}: found {found!r}, expected a whole number below 2^62")
        reward_from(values.get("reward", "tracking"))
        policy = values.get("policy", "-")
        if not (isinstance(policy, str) and policy):
            raise ValueError(f"policy: found {policy!r}, expected the name of one")
        if cell.kind == "train" and values.get("seed", 0) >= TRAINING_SEED:
            raise ValueError(f"seed: found {values['seed']}, expected the number of a training")
        if cell.kind == "train":
            for axis in values:
                if axis.startswith(HYPERPARAMETER):
                    kind_of(axis, values.get("algo", "ppo"))
    except ValueError as error:
        raise ValueError(f"{cell.kind}.{error}") from error


def kind_of(axis: str, algorithm: str) -> type:
    """The type of a hyperparameter.

    Raises:
        ValueError: the algorithm has no such one.
    """
    known = get_type_hints(HYPERPARAMETERS[algorithm])
    kind: type = choose(known, axis.removeprefix(HYPERPARAMETER), HYPERPARAMETER[:-1])
    return kind


def episode_args(values: Mapping[str, Any]) -> EpisodeArgs:
    """The options of compare that a cell is about."""
    args = EpisodeArgs(**{name: value for name, value in values.items() if name != "policy"})
    require_fields(args)
    return args


def task_args(values: Mapping[str, Any]) -> TaskArgs:
    """The options of train that a cell is about."""
    known = {field.name for field in fields(TaskArgs)}
    return TaskArgs(**{name: value for name, value in values.items() if name in known})
