"""Rows of a sweep: results of an evaluation or of a training."""

import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.asked import contender_of, task_of
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.seeds import Selection
from experiments.sweeping.spec import HYPERPARAMETER, Evaluation, Training, Values
from experiments.training.hyperparameters import Hyperparameters
from experiments.training.run import hyperparameters, training_task
from mmwave_env.metrics import METRICS

Row = dict[str, Any]


def evaluated(values: Values) -> Row:
    """Return means of the metrics of an evaluation, their 95 % intervals, and every episode's."""
    args = Evaluation(**values)
    selection = Selection(range(args.seed, args.seed + args.episodes))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        task, contender = task_of(args), contender_of(args, args.policy)
        (scores,) = score_contenders(
            [contender], task.source, args.radio, selection, scoring=Scoring.of(task)
        ).values()
    row: Row = {"warnings": "; ".join(sorted({str(one.message) for one in said}))}
    intervals = bootstrap(np.stack([*scores.values()], axis=1))
    for (metric, each), interval in zip(scores.items(), intervals, strict=True):
        row |= {f"{metric}_{part}": number for part, number in vars(interval).items()}
        row[f"{metric}_each"] = each.tolist()
    return row


def trained(values: Values, tell: Callable[[Row], None] = lambda row: None) -> Row:
    """Train; return the metrics of the best policy on tuning seeds, and its file.

    Args:
        values: value of every axis.
        tell: takes the row of every policy that is evaluated during the training.
    """
    from experiments.training.job import Job, News
    from experiments.training.processes import train

    args, found = training_of(values)

    def hear(news: News) -> None:
        if news.evaluation is not None:
            tell(_row({**news.evaluation, "timesteps": news.timesteps}))

    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            training_task(args), found, args.seed, args.total_timesteps, Path(folder),
            "mmwave-loc sweep", checkpoint_every=1 << 30, episodes=args.episodes,
        )  # fmt: skip
        return _row(train(job, hear)["best"]) | {"policy_file": job.policy.read_bytes()}


def _row(figures: Mapping[str, float]) -> Row:
    return {"timesteps": figures["timesteps"]} | {f"{m}_mean": figures[m] for m in METRICS}


def training_of(values: Values) -> tuple[Training, Hyperparameters]:
    """Return the options of a training, and the shipped hyperparameters with its changes."""
    changed = {k: v for k, v in values.items() if k.startswith(HYPERPARAMETER)}
    args = Training(**{k: v for k, v in values.items() if k not in changed})
    shipped = hyperparameters(args, len(args.places) or 1)
    return args, replace(shipped, **{k.removeprefix(HYPERPARAMETER): v for k, v in changed.items()})
