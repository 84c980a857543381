"""mmwave-loc sweep: many evaluations and trainings, on one machine or a cluster."""

import os
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from experiments.arguments.shared import EpisodeArgs
from experiments.arguments.sweep import Args
from experiments.arguments.train import Args as TrainArgs
from experiments.cli.main import run
from experiments.cli.options import contender_of, provenance, selection_of, task_of
from experiments.evaluation.markdown import HEADERS, grid, rounded, show
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.seeds import TUNING_SEED
from experiments.evaluation.terminal import note, progress
from experiments.sweeping.engines import Done, local, on_ray
from experiments.sweeping.results import ResultSet
from experiments.sweeping.spec import (
    HYPERPARAMETER,
    JUDGED,
    Cell,
    episode_args,
    read_spec,
    task_args,
)
from mmwave_env.files import write_json

SHOWN = ("reward", "ate_m", "rmse_m", "nees", "divergence_rate")
Result = dict[str, Any]


def compute(cell: Cell) -> Result:
    """What a cell comes to: which episodes, the metrics of each, and warnings on the way."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # cells run side by side
    values = dict(cell.values)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        if cell.kind == "train":
            found = _trained(values)
        else:
            found = _evaluated(episode_args(values), values["policy"])
    return found | {"warnings": sorted({str(one.message) for one in said})}


def _evaluated(args: EpisodeArgs, policy: str) -> Result:
    task, contender = task_of(args), contender_of(args, policy)
    selection = selection_of(args, task.source)
    scores = score_contenders(
        [contender], task.source, args.radio, selection, scoring=Scoring.of(task)
    )
    keys = selection.keys(task.source)
    return {
        "scores": scores[contender.name],
        "episode_seed": selection.seeds(),
        "episode_key": [None] * len(selection) if keys is None else keys,
    }


def _trained(values: Mapping[str, Any]) -> Result:
    """A policy, and what it earns on tuning seeds: a choice among trainings must not see others."""
    from experiments.train import hyperparameters, places_of, rewards
    from experiments.training.job import Job
    from experiments.training.trainers import TRAINERS
    from experiments.training.training_task import TrainingTask, banks_of

    args = TrainArgs(**vars(task_args(values)), total_timesteps=values["total_timesteps"])
    places = places_of(args)
    changed = {
        axis.removeprefix(HYPERPARAMETER): value
        for axis, value in values.items()
        if axis.startswith(HYPERPARAMETER)
    }
    recipe = replace(hyperparameters(args, len(places)), **changed)
    banks = banks_of(args.modes, places, args.beliefs)
    task = TrainingTask(args.scenario, places, banks, args.observation, rewards(args), args.beliefs)
    episodes = values.get("episodes", JUDGED)
    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            task, recipe, args.algo, values.get("seed", 0), values["total_timesteps"],
            Path(folder), "mmwave-loc sweep", checkpoint_every=1 << 30, episodes=episodes,
        )  # fmt: skip
        TRAINERS[args.algo](job, lambda steps, news: None).run()
        judged = EpisodeArgs(
            scenario=args.scenario, radio=args.radio, seed=TUNING_SEED, episodes=episodes
        )
        return _evaluated(judged, str(job.policy)) | {"policy": job.policy.read_bytes()}


def main(args: Args) -> None:
    """Run the command.

    Raises:
        ValueError: cells failed; all others are there.
    """
    for name in ("workers", "tries"):
        if getattr(args, name) < 1:
            raise ValueError(f"{name}: found {getattr(args, name)}, expected 1 or more")
    if args.address is not None and args.engine != "ray":
        raise ValueError("address: found one beside engine local, expected --engine ray")
    spec = read_spec(args.spec)
    results = ResultSet(args.out, spec)
    failed: list[Done] = []
    with results.locked():
        there = results.finished()
        todo = [cell for cell in spec.cells if cell.name not in there]
        kept = len(spec.cells) - len(todo)
        note(f"{len(spec.cells)} cells, {kept} of them kept from before, in {results.folder}")
        _run(args, results, todo, failed)
    _tell(args, results, failed, len(spec.cells))


def _run(args: Args, results: ResultSet, todo: list[Cell], failed: list[Done]) -> None:
    engine = partial(on_ray, address=args.address) if args.engine == "ray" else local
    said = set[str]()
    with progress("cells") as told:
        for count, done in enumerate(engine(compute, todo, args.workers, args.tries), start=1):
            if done.result is None:
                failed.append(done)
            else:
                results.add(done.cell, done.result)
                for warning in sorted({*done.result["warnings"]} - said):
                    warnings.warn(warning, stacklevel=2)
                said.update(done.result["warnings"])
            told(count / len(todo))


def _tell(args: Args, results: ResultSet, failed: list[Done], cells: int) -> None:
    """The summary, as a table and as a file that report reads."""
    summary = results.summary()
    write_json(results.folder / "summary.json", provenance("sweep", args) | {
        "cells": cells,
        "failed": [{"cell": str(one.cell), "error": one.error} for one in failed],
        "sweep": {name: {m: i.json for m, i in row.items()} for name, row in summary.items()},
    })  # fmt: skip
    show(_table(summary))
    if failed:
        raise ValueError(
            f"{len(failed)} of {cells} cells failed {args.tries} times, and the others are there; "
            f"the first is {failed[0].cell}: {failed[0].error}; {results.folder}/summary.json "
            "names all"
        )


def _table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    def rows() -> Iterator[list[str]]:
        for name, row in summary.items():
            yield [name, *(rounded(row[metric]) for metric in SHOWN)]

    return grid(["cells", *(HEADERS[metric] for metric in SHOWN)], list(rows())) + "\n"


if __name__ == "__main__":
    run("sweep")
