"""The sweep command, which reads a sweep's file, computes missing cells and shows a table.

A cell is a combination of values, one for each axis of the sweep.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from experiments.console.progress import note, say, tracked
from experiments.console.tables import grid, show
from experiments.evaluation.intervals import Interval, rounded
from experiments.sweeping.cells import evaluated, keep, kept, read, trained
from experiments.sweeping.on_ray import computed, connected
from experiments.sweeping.spec import HYPERPARAMETER, Spec, Values, read_spec
from mmwave_env.io.lookup import require_extra
from mmwave_env.metrics import HEADERS

SHOWN = ("reward", "ate_m", "rmse_m", "nees", "divergence_rate")


def sweep(file: Path, folder: Path, address: str | None, workers: int | None) -> None:
    """Compute, on Ray, the cells of a sweep that have no row in the folder yet; show all rows.

    Raises:
        ValueError: the file is not valid, the folder has rows of another sweep, or a cell failed.
    """
    spec = read_spec(file)
    if spec.kind == "train":
        require_extra("stable_baselines3", "train", f"training policies, as in {file},")
    done = kept(folder, spec)
    note(f"{len(spec)} cells, {len(done)} of them already in {folder}")
    todo = {name: values for name, values in spec.cells.items() if name not in done}
    failed = 0
    if todo:
        with connected(address, workers):
            failed = _computed(spec, folder, todo)
    if rows := read(folder, spec):
        show(_table(spec, rows))
        if spec.kind == "train":
            best = max(rows, key=lambda name: rows[name]["reward_mean"])
            say(f"The best of the trainings is {folder / best}.safetensors")
    if failed:
        raise ValueError(f"{failed} of {len(spec)} cells failed, the others are in {folder}")


def _computed(spec: Spec, folder: Path, todo: Mapping[str, Values]) -> int:
    """Compute missing cells, write their rows, and return the number of cells that failed."""
    failed = 0
    compute = evaluated if spec.kind == "evaluate" else trained
    for name, row, error in tracked(computed(compute, todo), "cells", len(todo)):
        if row is not None:
            keep(folder, name, todo[name], row)
        else:
            failed += 1
            cell = ", ".join(f"{axis} {value}" for axis, value in todo[name].items())
            note(f"failed: {cell}: {error}")
    return failed


def _table(spec: Spec, rows: Mapping[str, Values]) -> str:
    """Return a table of computed cells in the order of the file.

    Its columns are the axes that have several values, and metrics.
    """
    axes = [axis for axis, values in spec.axes.items() if len(values) > 1]
    header = [axis.removeprefix(HYPERPARAMETER) for axis in axes] + [HEADERS[m] for m in SHOWN]
    table = []
    for row in (rows[name] for name in spec.cells if name in rows):
        cells = [str(row[axis]) for axis in axes]
        for metric in SHOWN:
            ends = (row.get(f"{metric}_{part}", np.nan) for part in ("mean", "low", "high"))
            cells.append(rounded(Interval(*ends)))
        table.append(cells)
    return grid(header, table) + "\n"
