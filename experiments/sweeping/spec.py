"""Specification of a sweep: a TOML or JSON file, whose keys are axes with one or more values.

A *cell* is a combination of values, one of each axis. In a search, Optuna draws *trials* instead.
"""

import hashlib
import itertools
import json
import math
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from experiments.console.options import USUAL_EPISODES, ModeArgs, TaskArgs
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from mmwave_env import __version__
from mmwave_env.io.files import parse_json, read_text
from mmwave_env.io.lookup import choose, quoted, require_extra
from mmwave_env.io.records import Bound, counts, hints_of, require

MOST_CELLS = 100_000  # a cell takes a second or longer, so more cells must be a mistake
HYPERPARAMETER = "hyperparameters."  # prefix of the names of axes that are hyperparameters

Count = Annotated[int, counts(1, 10**12)]
Seed = Annotated[int, Bound("an integer from 0 to 10^15", least=0, most=1e15)]
Values = Mapping[str, Any]  # values of a cell, by axis


@dataclass(kw_only=True)
class Evaluation(ModeArgs):
    """Keys of a table [evaluate]: the options of `mmwave-loc compare` that affect its results."""

    policy: str
    reward: str = "tracking"
    episodes: Count = USUAL_EPISODES
    seed: Seed = 0  # seed of the first episode


@dataclass(kw_only=True)
class Training(TaskArgs):
    """Keys of a table [train], except hyperparameters: options of `mmwave-loc train`."""

    total_timesteps: Count
    seed: Seed = 0  # training seed, which determines the random numbers of the training
    episodes: Count = 200  # number of episodes to evaluate policies on


KINDS: Mapping[str, Any] = {"evaluate": Evaluation, "train": Training, "search": Training}


@dataclass(frozen=True)
class Spec:
    """A sweep: the axes of a grid, or the distributions of a search."""

    kind: str  # name of the table in the file
    axes: Mapping[str, Sequence[Any]]  # values of each key; in a search, a key has one value
    trials: int = 0  # number of trials of a search
    # Optuna's distributions of the hyperparameters that a search varies, by axis
    free: Values = field(default_factory=dict)

    def __len__(self) -> int:
        return self.trials or math.prod(map(len, self.axes.values()))

    @cached_property
    def cells(self) -> dict[str, Values]:
        """Return all combinations of values in a grid, by name, in the order of the file."""
        combinations = itertools.product(*self.axes.values())
        cells = (dict(zip(self.axes, values, strict=True)) for values in combinations)
        return {self._digest(values): values for values in cells}

    @property
    def trial(self) -> str:
        """Return the prefix of the names of all trials of a search."""
        return self._digest({**self.axes, **self.free})

    def values_of(self, row: Values) -> Values:
        """Return a trial's values on all axes; ``row`` has the values that the search drew."""
        values = {axis: value for axis, (value,) in self.axes.items()}
        for axis in self.free:
            value = json.loads(row[axis]) if isinstance(row[axis], str) else row[axis]
            values[axis] = tuple(value) if isinstance(value, list) else value
        return values

    def _digest(self, values: Values) -> str:
        """Return a hash of our version, the values, and the contents of files that values name."""
        words = itertools.chain(*(v if isinstance(v, tuple) else (v,) for v in values.values()))
        paths = (Path(word) for word in words if isinstance(word, str) and os.path.isfile(word))
        files = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]
        work = json.dumps([__version__, self.kind, sorted(values.items()), files], default=repr)
        return hashlib.sha256(work.encode()).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Return a bool or a tuple as JSON text, other values unchanged, for Parquet and Optuna."""
    return json.dumps(value) if isinstance(value, (bool, tuple)) else value


def read_spec(path: Path) -> Spec:
    """Read the file of a sweep: one table, whose name is one of :data:`KINDS`.

    The table's keys are fields of the class in KINDS. [train] and [search] may also have the key
    "hyperparameters", and [search] also has the key "trials".

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
    tried = table.pop("hyperparameters", {}) if kind != "evaluate" else {}
    require(f"{kind}.hyperparameters", tried, dict)
    trials = table.pop("trials", None) if kind == "search" else 1
    require(f"{kind}.trials", trials, Count)
    axes = dict(_options(kind, table))
    free = dict(_hyperparameters(kind, tried, axes))
    spec = Spec(kind, axes, trials, free) if kind == "search" else Spec(kind, axes | free)
    if len(spec) > MOST_CELLS:
        raise ValueError(f"{kind}: found {len(spec)} cells, expected at most {MOST_CELLS}")
    if kind == "search" and not (free and all(len(values) == 1 for values in axes.values())):
        raise ValueError("search: expected hyperparameters to try, and one value per remaining key")
    return spec


def _options(kind: str, table: Values) -> Iterator[tuple[str, Sequence[Any]]]:
    for option in fields(KINDS[kind]):
        if option.default is MISSING and option.name not in table:
            raise ValueError(f"{kind}.{option.name}: found none, expected a value")
    for key, content in table.items():
        hint = choose(hints_of(KINDS[kind]), key, f"{kind}: key")
        values = _values(key, content)
        for value in values:
            require(f"{kind}.{key}", value, hint)
        yield key, values


def _hyperparameters(kind: str, table: Values, axes: Values) -> Iterator[tuple[str, Any]]:
    """Yield the values or the distribution of each hyperparameter; refuse invalid values."""
    algo = axes.get("algo", [Training.algo])[0]
    beliefs = axes.get("beliefs", [Training.beliefs])[0]
    checked = read_hyperparameters(shipped_hyperparameters(algo, beliefs), algo)
    types = get_type_hints(type(checked))
    for name, content in table.items():
        axis = HYPERPARAMETER + name
        of_type = choose(types, name, f"{kind}.hyperparameters")
        is_range = kind == "search" and isinstance(content, dict)
        values = [content.get("low"), content.get("high")] if is_range else _values(name, content)
        for value in reversed(values):
            checked = replace(checked, **{name: value})
        if kind == "search":
            values = _distribution(axis, content if is_range else values, of_type is int)
        yield axis, values


def _distribution(axis: str, choices: Any, whole: bool) -> Any:
    """Return the distribution from which Optuna draws: a range, or a list of choices."""
    require_extra("optuna", "ray", "a search")
    from optuna import distributions

    try:
        if not isinstance(choices, dict):
            return distributions.CategoricalDistribution([*map(plain, choices)])
        kind = distributions.IntDistribution if whole else distributions.FloatDistribution
        return kind(**choices)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{axis}: found {quoted(choices)}, expected a range: {error}") from error


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
