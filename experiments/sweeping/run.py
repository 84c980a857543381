"""The sweep command, which reads a sweep's file, computes missing cells and shows a table.

A cell is a combination of values, one for each axis of the sweep.
"""

import shlex
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from experiments.console.progress import note, progress, say
from experiments.console.provenance import command_line
from experiments.console.tables import grid, show
from experiments.evaluation.intervals import Interval, rounded
from experiments.sweeping.cells import evaluated, keep, kept, read, trained, training_of
from experiments.sweeping.on_ray import computed, connected, searched
from experiments.sweeping.spec import HYPERPARAMETER, Spec, Training, Values, read_spec
from experiments.training.hyperparameters import hyperparameters_as_written
from mmwave_env.io.files import write_json
from mmwave_env.io.lookup import require_extra
from mmwave_env.metrics import HEADERS

SHOWN = ("reward", "ate_m", "rmse_m", "nees", "divergence_rate")


def sweep(file: Path, folder: Path, address: str | None, workers: int | None) -> None:
    """Compute, on Ray, the cells of a sweep that have no row in the folder yet; show all rows.

    Raises:
        ValueError: the file is not valid, the folder has rows of another sweep, or a cell failed.
    """
    spec = read_spec(file)
    if spec.kind != "evaluate":
        require_extra("stable_baselines3", "train", f"training policies, as in {file},")
    done = kept(folder, spec)
    failed = list[str]()
    note(f"{len(spec)} cells, {len(done)} of them already in {folder}")
    if len(done) < len(spec):
        with connected(address, workers):
            for failure in _failures(spec, folder, done):
                note(f"failed: {failure}")
                failed.append(failure)
    if rows := read(folder, spec):
        show(_table(spec, rows))
        if spec.kind != "evaluate":
            _tell_best(spec, folder, rows)
    if failed:
        raise ValueError(f"{len(failed)} of {len(spec)} cells failed, the others are in {folder}")


def _failures(spec: Spec, folder: Path, done: Collection[str]) -> Iterator[str]:
    """Compute missing cells, write their rows, and yield a message for each failure."""
    if spec.free:
        yield from searched(trained, spec, read(folder, spec), partial(keep, folder))
        return
    todo = {name: values for name, values in spec.cells.items() if name not in done}
    compute = evaluated if spec.kind == "evaluate" else trained
    with progress("cells") as bar:
        for number, (name, row, error) in enumerate(computed(compute, todo), start=1):
            if row is not None:
                keep(folder, name, todo[name], row)
            else:
                cell = ", ".join(f"{axis} {value}" for axis, value in todo[name].items())
                yield f"{cell}: {error}"
            bar(number / len(todo))


def _table(spec: Spec, rows: Mapping[str, Values]) -> str:
    """Return a table of computed cells: values of the axes that have several values, then metrics.

    The rows are in the order of the file; the rows of a search are in the order of their rewards.
    """
    axes = [axis for axis, values in spec.axes.items() if len(values) > 1]
    names = [name for name in spec.cells if name in rows]
    if spec.free:
        axes = [*spec.free, "timesteps"]
        names = sorted(rows, key=lambda n: -rows[n]["reward_mean"])

    def cells(row: Values) -> Iterator[str]:
        yield from (str(row[axis]) for axis in axes)
        for metric in SHOWN:
            ends = (row.get(f"{metric}_{part}", np.nan) for part in ("mean", "low", "high"))
            yield rounded(Interval(*ends))

    header = [axis.removeprefix(HYPERPARAMETER) for axis in axes] + [HEADERS[m] for m in SHOWN]
    return grid(header, [[*cells(rows[name])] for name in names]) + "\n"


def _tell_best(spec: Spec, folder: Path, rows: Mapping[str, Values]) -> None:
    """Print which training run was best on tuning seeds and, for a search, how to repeat it."""
    best = max(rows, key=lambda name: rows[name]["reward_mean"])
    if not spec.free:
        say(f"The best of the trainings is {folder / best}.safetensors")
        return
    path = folder / "hyperparameters.json"
    args, tried = training_of(spec.values_of(rows[best]))
    write_json(path, hyperparameters_as_written(tried))
    train = command_line("train", replace(args, seed=Training.seed, episodes=Training.episodes))
    say("To train like the best trial:", f"{train} --hyperparameters {shlex.quote(str(path))}")
