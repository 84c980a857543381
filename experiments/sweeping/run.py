"""Sweeps: grids of evaluations or of training runs, computed on Ray.

A sweep is a TOML file, whose keys are axes with one or more values. A cell is a combination
of values, one of each axis. Cells that have no row yet are computed, on this machine or on a
cluster; the row of a cell is a Parquet file.
"""

import hashlib
import itertools
import json
import logging
import math
import os
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from experiments.console.options import USUAL_EPISODES, ModeArgs, TaskArgs
from experiments.console.output import grid, note, say, show, tracked
from experiments.console.signals import heed_signals
from experiments.evaluation.agents import is_agent, module_file
from experiments.evaluation.contenders import contender_of, seeds_from, task_of
from experiments.evaluation.intervals import Interval, bootstrap, rounded
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.training.hyperparameters import (
    hyperparameters,
    read_hyperparameters,
    shipped_hyperparameters,
)
from experiments.training.training_task import training_task, with_beliefs
from mmwave_env import __version__
from mmwave_env.io.files import atomic_path, first_line, read_text, write_bytes
from mmwave_env.io.lookup import choose, quoted, require_extra
from mmwave_env.io.records import Bound, Record, counts, object_from, require
from mmwave_env.metrics import HEADERS, METRICS

MOST_CELLS = 100_000  # a cell takes a second or longer, so more cells must be a mistake
HYPERPARAMETER = "hyperparameters."  # prefix of the names of axes that are hyperparameters

Count = Annotated[int, counts(1, 10**12)]
Seed = Annotated[int, Bound("an integer from 0 to 10^15", least=0, most=1e15)]
Values = Mapping[str, Any]  # values of a cell, by axis
Axes = dict[str, Sequence[Any]]  # values of each axis, by its key


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


class Spec(NamedTuple):
    """A sweep: the axes of a grid, and its cells."""

    kind: str  # name of the table in the file
    axes: Axes
    cells: dict[str, Values]  # all combinations of values, by name, in the order of the file


def read_spec(path: Path) -> Spec:
    """Read the file of a sweep: one table, whose name is one of :data:`KINDS`.

    The table's keys are fields of the class in KINDS; [train] may also have the key
    "hyperparameters".

    Raises:
        ValueError: the file is not a sweep; the message names the file and the key.
        FileNotFoundError: there is no such file.
    """
    text = read_text(path, "a sweep, TOML")
    try:
        return _spec(tomllib.loads(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a sweep: {error} (docs/sweep.md)") from error


def _spec(content: Mapping[str, Any]) -> Spec:
    if len(content) != 1:
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
    count = math.prod(map(len, axes.values()))
    if count > MOST_CELLS:
        raise ValueError(f"{kind}: found {count} cells, expected at most {MOST_CELLS}")
    combinations = itertools.product(*axes.values())
    cells = [dict(zip(axes, values, strict=True)) for values in combinations]
    return Spec(kind, axes, {_name(kind, cell): cell for cell in cells})


def _name(kind: str, cell: Values) -> str:
    """Return a hash of our version, a cell's values, and the contents of files that they name.

    Values may name files, folders, modules of agents, and places with files.
    """
    values = itertools.chain(*(v if isinstance(v, tuple) else (v,) for v in cell.values()))
    words = ":".join(value for value in values if isinstance(value, str)).split(":")
    paths = [*map(Path, filter(None, words))]
    policy = cell.get("policy", "")
    if is_agent(policy):
        paths.append(module_file(policy))
    files = [
        hashlib.sha256(file.read_bytes()).hexdigest()
        for path in paths
        for file in (path, *sorted(path.rglob("*")))
        if file.is_file()
    ]
    work = json.dumps([__version__, kind, sorted(cell.items()), files], default=repr)
    return hashlib.sha256(work.encode()).hexdigest()[:16]


def _axes(kind: type[Any], table: Values, others: Values, where: str) -> Axes:
    """Return the axes of a table; refuse values that ``kind`` refuses beside the ``others``."""
    axes: Axes = {}
    for key, content in table.items():
        several = isinstance(content, list)
        # each value of these keys is itself a list
        if several and key in ("modes", "places", "measurements"):
            several = all(isinstance(value, list) for value in content)
        listed = content if several else [content]
        values = [tuple(value) if isinstance(value, list) else value for value in listed]
        if not values or len(set(map(repr, values))) < len(values):
            raise ValueError(f"{key}: found {quoted(content)}, expected values without repeats")
        if any(isinstance(value, float) for value in values):  # a Parquet column has one type
            values = [float(value) if type(value) is int else value for value in values]
        axes[key] = values
    first = {**others} | {key: values[0] for key, values in axes.items()}
    object_from(kind, first, where)
    for key, tried in axes.items():
        for value in tried:
            object_from(kind, first | {key: value}, where)
    return axes


RETRIES = 2  # maximum repeats of a cell whose process ran out of memory, ended, or raised OSError
AHEAD = 1000  # maximum number of cells submitted to Ray at a time; also limits busy workers
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_task_oom_retries": str(RETRIES),  # unlimited by default
    "RAY_agent_register_timeout_ms": "120000",  # Ray starts slowly on a busy machine
}


@contextmanager
def connected(address: str | None, workers: int | None) -> Iterator[None]:
    """Connect to the cluster at an address during the ``with`` block, and send it this code.

    Without an address, start Ray on this machine with ``workers`` processes (None: one per core).
    """
    os.environ |= ENVIRONMENT | ({"RAY_NUM_REDIS_GET_RETRIES": "1"} if address else {})
    import ray

    options: dict[str, Any] = {
        "num_cpus": workers,
        "object_store_memory": 100 << 20,  # rows are small
    }
    if address is not None:
        root = Path(__file__).resolve().parents[2]
        folders = [str(root / package) for package in ("mmwave_env", "policies", "experiments")]
        options = {"address": address, "runtime_env": {"py_modules": folders}}
    options |= {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    # Hide what Ray prints.
    with ray.init(**options), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        heed_signals()  # Ray has installed its own handlers
        yield


def computed(
    compute: Callable[[Values], Values], cells: Mapping[str, Values]
) -> Iterator[tuple[str, Values | None, str]]:
    """Yield every finished cell: its name, its row (None if the cell failed) and its error message.

    ``compute`` maps the values of a cell to its row.
    """
    import ray

    task: Any = ray.remote(lambda values: compute(values))  # noqa: PLW0108  Ray wants functions
    task = task.options(num_cpus=1, max_retries=RETRIES, retry_exceptions=[OSError])
    waiting = iter(cells.items())
    running = dict[Any, str]()
    while True:
        for name, values in itertools.islice(waiting, AHEAD - len(running)):
            running[task.remote(values)] = name
        if not running:
            return
        (finished,), _ = ray.wait(list(running))
        name = running.pop(finished)
        try:
            yield name, ray.get(finished), ""
        except ray.exceptions.RayError as error:
            cause = getattr(error, "cause", None)
            ended = f"its process ended {RETRIES + 1} times ({type(error).__name__})"
            yield name, None, f"{type(cause).__name__}: {first_line(cause)}" if cause else ended


Row = dict[str, Any]


def evaluated(values: Values) -> Row:
    """Evaluate a policy; return each metric's mean, 95 % interval and values per episode."""
    args = Evaluation(**values)
    seeds = seeds_from(args.episodes, args.seed)
    task = task_of(args)
    contender = contender_of(args, args.policy)
    (scores,) = score_contenders([contender], task.source, seeds, scoring=Scoring.of(task)).values()
    row = Row()
    intervals = bootstrap([*scores.values()])
    for (metric, each), interval in zip(scores.items(), intervals, strict=True):
        row |= {f"{metric}_{part}": number for part, number in interval._asdict().items()}
        row[f"{metric}_each"] = each.tolist()
    return row


def trained(values: Values) -> Row:
    """Train a policy; return the metrics of its best version on tuning seeds, and its policy file.

    The values that are no hyperparameters are options of `train`; they replace its defaults.
    """
    from experiments.training.run import train
    from experiments.training.trainer import Job

    options = dict[str, Any]()
    changed = dict[str, Any]()
    for axis, value in values.items():
        if axis.startswith(HYPERPARAMETER):
            changed[axis.removeprefix(HYPERPARAMETER)] = value
        else:
            options[axis] = value
    args = with_beliefs(Training(**options))
    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            training_task(args),
            hyperparameters(args, len(args.places) or 1, **changed),
            args.seed,
            args.total_timesteps,
            Path(folder),
            "mmwave-loc sweep",
            episodes=args.episodes,
        )
        best = train(job, lambda *_: None)["best"]
        row = {"timesteps": best["timesteps"]}
        row |= {f"{metric}_mean": best[metric] for metric in METRICS if metric in best}
        return row | {"policy_file": job.policy.read_bytes()}


def kept(folder: Path, spec: Spec) -> set[str]:
    """Return the names of the cells stored in a folder; refuse another sweep's rows."""
    names = {path.stem for path in folder.glob("[!.]*.parquet")}  # hidden files are incomplete
    for name in names:
        if name not in spec.cells:
            raise ValueError(
                f"{folder / name}.parquet: found a row of another sweep, of another version, or of "
                "this sweep before one of its files changed; choose another folder with --out"
            )
    return names


def keep(folder: Path, name: str, values: Values, result: Values) -> None:
    """Write the row of a cell and, for a training, its policy file."""
    import pyarrow
    from pyarrow import parquet

    row: Row = {  # Parquet has neither tuples nor, in a column of texts, bools
        axis: json.dumps(value) if isinstance(value, (bool, tuple)) else value
        for axis, value in values.items()
    } | dict(result)
    if "policy_file" in row:
        write_bytes(folder / f"{name}.safetensors", row.pop("policy_file"))
    with atomic_path(folder / f"{name}.parquet") as temporary:
        parquet.write_table(pyarrow.Table.from_pylist([row]), temporary, write_page_checksum=True)


def read(folder: Path, spec: Spec) -> dict[str, Values]:
    """Read the rows of a sweep, by name, in the order of its file; errors name a damaged row."""
    from pyarrow import ArrowException, parquet

    rows = {}
    names = kept(folder, spec)
    for name in filter(names.__contains__, spec.cells):
        path = folder / f"{name}.parquet"
        try:
            (rows[name],) = parquet.read_table(path, page_checksum_verification=True).to_pylist()
        except (ArrowException, OSError, ValueError) as error:
            raise ValueError(
                f"{path}: found no row ({first_line(error)}); remove the file"
            ) from error
    return rows


def sweep(file: Path, folder: Path, address: str | None, workers: int | None) -> None:
    """Compute, on Ray, the cells of a sweep that have no row in the folder yet; show all rows.

    Raises:
        ValueError: the file is not valid, the folder has rows of another sweep, or a cell failed.
    """
    spec = read_spec(file)
    if spec.kind == "train":
        require_extra("stable_baselines3", "train", f"training policies, as in {file},")
    done = kept(folder, spec)
    note(f"{len(spec.cells)} cells, {len(done)} of them already in {folder}")
    todo = {name: values for name, values in spec.cells.items() if name not in done}
    compute = evaluated if spec.kind == "evaluate" else trained
    failed = 0
    with connected(address, workers) if todo else nullcontext():
        for name, row, error in tracked(computed(compute, todo), "cells", len(todo)):
            if row is not None:
                keep(folder, name, todo[name], row)
                continue
            failed += 1
            cell = ", ".join(f"{axis} {value}" for axis, value in todo[name].items())
            note(f"failed: {cell}: {error}")
    if rows := read(folder, spec):
        axes = [axis for axis, values in spec.axes.items() if len(values) > 1]
        header = [axis.removeprefix(HYPERPARAMETER) for axis in axes] + [
            HEADERS[m] for m in METRICS
        ]
        table = []
        for row in rows.values():
            table.append([row[axis] for axis in axes])
            for metric in METRICS:
                ends = (row.get(f"{metric}_{part}", np.nan) for part in Interval._fields)
                table[-1].append(rounded(Interval(*ends)))
        show(grid(header, table) + "\n")
        if spec.kind == "train":
            best = max(rows, key=lambda name: rows[name]["reward_mean"])
            say(f"The best of the trainings is {folder / best}.safetensors")
    if failed:
        raise ValueError(f"{failed} of {len(spec.cells)} cells failed, the others are in {folder}")
