"""Specification of a sweep: a TOML or JSON file, whose keys are axes with one or more values.

A *cell* is a combination of values, one of each axis.
"""

import hashlib
import itertools
import json
import math
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from experiments.console.options import USUAL_EPISODES, ModeArgs, TaskArgs
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from mmwave_env import __version__
from mmwave_env.io.files import parse_json, read_text
from mmwave_env.io.lookup import choose, quoted
from mmwave_env.io.records import Bound, Record, counts, object_from, require

MOST_CELLS = 100_000  # a cell takes a second or longer, so more cells must be a mistake
HYPERPARAMETER = "hyperparameters."  # prefix of the names of axes that are hyperparameters

Count = Annotated[int, counts(1, 10**12)]
Seed = Annotated[int, Bound("an integer from 0 to 10^15", least=0, most=1e15)]
Values = Mapping[str, Any]  # values of a cell, by axis


@dataclass(kw_only=True)
class Evaluation(ModeArgs, Record):
    """Keys of a table [evaluate]: the options of `mmwave-loc compare` that affect its results."""

    policy: str
    reward: str = "tracking"
    episodes: Count = USUAL_EPISODES
    seed: Seed = 0  # seed of the first episode


@dataclass(kw_only=True)
class Training(TaskArgs, Record):
    """Keys of a table [train], except hyperparameters: options of `mmwave-loc train`."""

    total_timesteps: Count
    seed: Seed = 0  # training seed, which determines the random numbers of the training
    episodes: Count = 200  # number of episodes to evaluate policies on


KINDS: Mapping[str, Any] = {"evaluate": Evaluation, "train": Training}


@dataclass(frozen=True)
class Spec:
    """A sweep: the axes of a grid."""

    kind: str  # name of the table in the file
    axes: Mapping[str, Sequence[Any]]  # values of each key

    def __len__(self) -> int:
        return math.prod(map(len, self.axes.values()))

    @cached_property
    def cells(self) -> dict[str, Values]:
        """Return all combinations of values, by name, in the order of the file."""
        combinations = itertools.product(*self.axes.values())
        cells = (dict(zip(self.axes, values, strict=True)) for values in combinations)
        return {self._digest(values): values for values in cells}

    def _digest(self, values: Values) -> str:
        """Return a hash of our version, the values, and the contents of files that values name."""
        words = itertools.chain(*(v if isinstance(v, tuple) else (v,) for v in values.values()))
        paths = (Path(word) for word in words if isinstance(word, str) and os.path.isfile(word))
        files = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
        work = json.dumps([__version__, self.kind, sorted(values.items()), files], default=repr)
        return hashlib.sha256(work.encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Return a bool or a tuple as JSON text, other values unchanged, for Parquet."""
    return json.dumps(value) if isinstance(value, (bool, tuple)) else value


def read_spec(path: Path) -> Spec:
    """Read the file of a sweep: one table, whose name is one of :data:`KINDS`.

    The table's keys are fields of the class in KINDS; [train] may also have the key
    "hyperparameters".

    Raises:
        ValueError: the file is not a sweep; the message names the file and the key.
        FileNotFoundError: there is no such file.
    """
    text = read_text(path, "a sweep, TOML or JSON")
    try:
        return _spec(parse_json(text) if path.suffix == ".json" else tomllib.loads(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a sweep: {error} (docs/sweep.md)") from error


def _spec(content: Any) -> Spec:
    if not isinstance(content, dict) or len(content) != 1:
        raise ValueError(f"found {quoted(content)}, expected one table: {' or '.join(KINDS)}")
    ((kind, table),) = content.items()
    choose(KINDS, kind, "table")
    require(kind, table, dict)
    tried = table.pop("hyperparameters", {}) if kind == "train" else {}
    require(f"{kind}.hyperparameters", tried, dict)
    axes = _axes(KINDS[kind], table, {}, f"{kind}.")
    if tried:
        algo = axes.get("algo", [Training.algo])[0]
        beliefs = axes.get("beliefs", [Training.beliefs])[0]
        shipped = read_hyperparameters(shipped_hyperparameters(algo, beliefs), algo)
        changed = _axes(type(shipped), tried, vars(shipped), "train.hyperparameters.")
        axes |= {HYPERPARAMETER + name: values for name, values in changed.items()}
    spec = Spec(kind, axes)
    if len(spec) > MOST_CELLS:
        raise ValueError(f"{kind}: found {len(spec)} cells, expected at most {MOST_CELLS}")
    return spec


def _axes(kind: type[Any], table: Values, others: Values, where: str) -> dict[str, Sequence[Any]]:
    """Return the axes of a table; refuse values that ``kind`` refuses beside the ``others``."""
    axes = {key: _values(key, content) for key, content in table.items()}
    first = {**others} | {key: values[0] for key, values in axes.items()}
    object_from(kind, first, where)
    for key, values in axes.items():
        for value in values:
            object_from(kind, first | {key: value}, where)
    return axes


def _values(key: str, content: Any) -> Sequence[Any]:
    """Return an axis's values; each value of "modes" or "places" is itself a list."""
    several = isinstance(content, list) and (
        key not in ("modes", "places") or all(isinstance(value, list) for value in content)
    )
    values = [tuple(v) if isinstance(v, list) else v for v in (content if several else [content])]
    if not values or len(set(map(repr, values))) < len(values):
        raise ValueError(f"{key}: found {quoted(content)}, expected values without repeats")
    if any(isinstance(value, float) for value in values):  # a Parquet column has one type
        return [float(value) if type(value) is int else value for value in values]
    return values
