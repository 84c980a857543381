"""mmwave-loc sweep: many evaluations and trainings, on one machine or a cluster."""

import os
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from experiments.console.options import EpisodeArgs

if TYPE_CHECKING:
    from experiments.sweeping.cell import Cell, Done, Result
    from experiments.sweeping.results import ResultSet
    from experiments.sweeping.spec import Spec
    from experiments.train import Args as TrainArgs
    from experiments.training.hyperparameters import Hyperparameters


@dataclass(kw_only=True)
class Args:
    """Grids of policies, users, radios, scenes, seeds and hyperparameters, cell by cell.

    The file says what is to be done (docs/sweep.md). What is there is not computed again: a sweep
    that was ended goes on. Cells that fail are told at the end; the others are whole.

    mmwave-loc sweep grid.toml --out sweeps
    """

    spec: Positional[Path]
    """TOML file: [evaluate] and [train], whose lists are combined, or [search], by Ray alone"""
    out: Path = Path("sweeps")
    """folder of the data set: Parquet, a folder a run, a row an episode"""
    engine: Literal["local", "ray"] = "local"
    """processes of this machine, or Ray"""
    address: str | None = None
    """of a Ray cluster: auto, or HOST:PORT; this machine alone, where none is given"""
    workers: int = os.cpu_count() or 1
    """how many cells at once, without an address"""
    tries: int = 2
    """of a cell before it has failed"""


SHOWN = ("reward", "ate_m", "rmse_m", "nees", "divergence_rate")
BEST = "hyperparameters.json"


def compute(cell: "Cell") -> "Result":
    """What a cell comes to: which episodes, the metrics of each, and warnings on the way."""
    from experiments.sweeping.cell import episode_args

    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # cells run side by side
    values = dict(cell.values)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        if cell.kind == "train":
            found = _trained(values)
        else:
            found = _evaluated(episode_args(values), values["policy"])
    return found | {"warnings": sorted({str(one.message) for one in said})}


def _evaluated(args: EpisodeArgs, policy: str) -> "Result":
    from experiments.evaluation.asked import contender_of, selection_of, task_of
    from experiments.evaluation.runner import Scoring, score_contenders

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


def _trained(values: Mapping[str, Any]) -> "Result":
    """A policy, and what it earns on tuning seeds: a choice among trainings must not see others."""
    from experiments.evaluation.seeds import TUNING_SEED
    from experiments.sweeping.cell import JUDGED
    from experiments.training.job import Job
    from experiments.training.processes import train
    from experiments.training.run import places_of, rewards
    from experiments.training.training_task import TrainingTask, banks_of

    args, found = _train_args(values), _hyperparameters(values)
    places = places_of(args)
    banks = banks_of(args.modes, places, args.beliefs)
    task = TrainingTask(args.scenario, places, banks, args.observation, rewards(args), args.beliefs)
    episodes = values.get("episodes", JUDGED)
    with tempfile.TemporaryDirectory() as folder:
        job = Job(
            task, found, values.get("seed", 0), values["total_timesteps"], Path(folder),
            "mmwave-loc sweep", checkpoint_every=1 << 30, episodes=episodes,
        )  # fmt: skip
        train(job, lambda news: None)
        judged = EpisodeArgs(
            scenario=args.scenario, radio=args.radio, seed=TUNING_SEED, episodes=episodes
        )
        return _evaluated(judged, str(job.policy)) | {"policy": job.policy.read_bytes()}


def _train_args(values: Mapping[str, Any]) -> "TrainArgs":
    from experiments.sweeping.cell import task_args
    from experiments.train import Args as TrainArgs

    return TrainArgs(**vars(task_args(values)), total_timesteps=values["total_timesteps"])


def _hyperparameters(values: Mapping[str, Any]) -> "Hyperparameters":
    """The shipped hyperparameters, but for those that a cell has."""
    from experiments.sweeping.cell import HYPERPARAMETER
    from experiments.training.run import hyperparameters, places_of

    args = _train_args(values)
    changed = {
        axis.removeprefix(HYPERPARAMETER): value
        for axis, value in values.items()
        if axis.startswith(HYPERPARAMETER)
    }
    return replace(hyperparameters(args, len(places_of(args))), **changed)


def main(args: Args) -> None:
    """Run the command.

    Raises:
        ValueError: cells failed; all others are there.
    """
    from experiments.console.progress import note
    from experiments.sweeping.results import ResultSet
    from experiments.sweeping.spec import read_spec
    from mmwave_env.lookup import require_extra
    from mmwave_env.models.radio import radio_from

    for name in ("workers", "tries"):
        if getattr(args, name) < 1:
            raise ValueError(f"{name}: found {getattr(args, name)}, expected 1 or more")
    if args.address is not None and args.engine != "ray":
        raise ValueError("address: found one beside engine local, expected --engine ray")
    spec = read_spec(args.spec)
    if spec.trains:
        require_extra("stable_baselines3", "train", f"{args.spec}, which trains,")
    if spec.search is not None:
        if args.engine != "ray":
            raise ValueError("engine: found local beside a table [search], expected --engine ray")
        radio_from(_train_args(dict(spec.search.fixed)).radio)
        _hyperparameters(dict(spec.search.fixed))  # what all trials have is wrong before any begins
    for cell in spec.cells:
        if cell.kind == "train":
            _hyperparameters(dict(cell.values))
    results = ResultSet(args.out, spec)
    with results.locked():
        there = results.finished()
        kept = "those over" if spec.search else f"{len(there)} of them"
        note(f"{_counted(spec)}, {kept} kept from before, in {results.folder}")
        failed = _run(args, spec, results, there)
    _tell(args, spec, results, failed)


def _run(args: Args, spec: "Spec", results: "ResultSet", there: set[str]) -> "list[Done]":
    """Compute what is not there and keep it; what failed."""
    from experiments.console.progress import progress
    from experiments.sweeping.cell import Done
    from experiments.sweeping.engines import local, on_ray
    from experiments.sweeping.tuner import trials

    if spec.search is None:
        engine = partial(on_ray, address=args.address) if args.engine == "ray" else local
        todo = [cell for cell in spec.cells if cell.name not in there]
        found: Iterable[Done] = engine(compute, todo, args.workers, args.tries)
        count = len(todo)
    else:
        found = trials(compute, spec.search, results.folder, args.workers, args.tries, args.address)
        count = len(spec)
    failed, said = list[Done](), set[str]()
    with progress("cells") as told:
        for number, done in enumerate(found, start=1):
            if done.result is None:
                failed.append(done)
            elif done.cell.name not in there:
                results.add(done.cell, done.result)
                there.add(done.cell.name)
                for warning in sorted({*done.result["warnings"]} - said):
                    warnings.warn(warning, stacklevel=2)
                said.update(done.result["warnings"])
            told(number / count)
    return failed


def _tell(args: Args, spec: "Spec", results: "ResultSet", failed: "list[Done]") -> None:
    """The summary, as a table and as a file that report reads; the best of a search as one."""
    from experiments.console.progress import say
    from experiments.console.provenance import command_line, provenance
    from experiments.console.tables import show
    from experiments.sweeping.cell import JUDGED
    from experiments.training.hyperparameters import hyperparameters_as_written
    from mmwave_env.files import write_json

    summary, lost = results.summary(), {one.cell for one in failed}
    write_json(results.folder / "summary.json", provenance("sweep", args) | {
        "cells": len(spec),
        "failed": [{"cell": str(one.cell), "error": one.error} for one in failed],
        "sweep": {name: {m: i.json for m, i in row.items()} for name, row in summary.items()},
    })  # fmt: skip
    if summary:
        show(_table(summary))
    if spec.search is not None and summary:
        fixed, path = dict(spec.search.fixed), results.folder / BEST
        write_json(path, hyperparameters_as_written(_hyperparameters(fixed | results.best())))
        train = command_line("train", replace(_train_args(fixed), hyperparameters=path))
        say(f"On {fixed.get('episodes', JUDGED)} tuning episodes. To train as the best did:", train)
    elif trained := [one for one in spec.cells if one.kind == "train" and one not in lost]:
        best = max(trained, key=lambda cell: summary[results.label(cell)]["reward"].mean)
        say(f"The best of the trainings is {results.policy_of(best)}")
    if failed:
        others = ", the others are there" if summary else ""
        raise ValueError(
            f"{len(failed)} of {_counted(spec)} failed {args.tries} times{others}; the first is "
            f"{failed[0].cell}: {failed[0].error}; {results.folder}/summary.json names all"
        )


def _counted(spec: "Spec") -> str:
    what = "cell" if spec.search is None else "trial"
    return f"{len(spec)} {what}{'s' if len(spec) > 1 else ''}"


def _table(summary: Mapping[str, Mapping[str, Any]]) -> str:
    from experiments.console.tables import HEADERS, grid
    from experiments.evaluation.intervals import rounded

    def rows() -> Iterator[list[str]]:
        for name, row in summary.items():
            yield [name, *(rounded(row[metric]) for metric in SHOWN)]

    return grid(["cells", *(HEADERS[metric] for metric in SHOWN)], list(rows())) + "\n"
