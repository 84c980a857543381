"""Rows of a sweep in a folder of Parquet files: one row for each cell (combination of values)."""

import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.asked import contender_of, task_of
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.seeds import seeds_from
from experiments.sweeping.spec import HYPERPARAMETER, Evaluation, Spec, Training, Values, plain
from experiments.training.run import hyperparameters, training_task
from mmwave_env.io.files import atomic_path, first_line, write_bytes
from mmwave_env.metrics import METRICS

Row = dict[str, Any]


def evaluated(values: Values) -> Row:
    """Evaluate a policy; return each metric's mean, 95 % interval and values per episode."""
    args = Evaluation(**values)
    seeds = seeds_from(args.episodes, args.seed)
    with warnings.catch_warnings(record=True, action="always", category=UserWarning) as warned:
        task = task_of(args)
        contender = contender_of(args, args.policy)
        (scores,) = score_contenders(
            [contender], task.source, seeds, scoring=Scoring.of(task)
        ).values()
    row: Row = {"warnings": "; ".join(sorted({str(warning.message) for warning in warned}))}
    intervals = bootstrap(np.stack([*scores.values()], axis=1))
    for (metric, each), interval in zip(scores.items(), intervals, strict=True):
        row |= {f"{metric}_{part}": number for part, number in vars(interval).items()}
        row[f"{metric}_each"] = each.tolist()
    return row


def trained(values: Values) -> Row:
    """Train a policy; return the metrics of its best version on tuning seeds, and its policy file.

    The values that are no hyperparameters are options of `train`; they replace its defaults.
    """
    from experiments.training.job import Job
    from experiments.training.processes import train

    options = dict[str, Any]()
    changed = dict[str, Any]()
    for axis, value in values.items():
        if axis.startswith(HYPERPARAMETER):
            changed[axis.removeprefix(HYPERPARAMETER)] = value
        else:
            options[axis] = value
    args = Training(**options)
    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            training_task(args),
            hyperparameters(args, len(args.places) or 1, **changed),
            args.seed,
            args.total_timesteps,
            Path(folder),
            "mmwave-loc sweep",
            checkpoint_every=1 << 30,
            episodes=args.episodes,
        )
        best = train(job, lambda *_: None)["best"]
        row: Row = {"timesteps": best["timesteps"]}
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

    row = {axis: plain(value) for axis, value in values.items()} | dict(result)
    if "policy_file" in row:
        write_bytes(folder / f"{name}.safetensors", row.pop("policy_file"))
    with atomic_path(folder / f"{name}.parquet") as temporary:
        parquet.write_table(pyarrow.Table.from_pylist([row]), temporary)


def read(folder: Path, spec: Spec) -> dict[str, Values]:
    """Read the rows of a sweep, by the names of their cells; an error names the damaged file."""
    from pyarrow import ArrowException, parquet

    rows = {}
    for name in sorted(kept(folder, spec)):
        path = folder / f"{name}.parquet"
        try:
            (rows[name],) = parquet.read_table(path).to_pylist()
        except (ArrowException, OSError, ValueError) as error:
            raise ValueError(
                f"{path}: found no row ({first_line(error)}); remove the file"
            ) from error
    return rows
