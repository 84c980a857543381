"""Hyperparameters are searched for by Ray Tune, with Optuna's sampler."""

import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.console.progress import note
from experiments.sweeping.cell import Cell, Compute, Done, Result
from experiments.sweeping.engines import ray_at
from experiments.sweeping.search import Range, Search
from mmwave_env.lookup import require_extra

_FOLDER = ".tune"  # where Tune keeps how far it is: hidden, for its files are not results
_GOAL = "mean_reward"  # what is made great
_SEED = 0  # of the sampler: with one worker, a search proposes the same again


def trials(
    compute: Compute, search: Search, folder: Path, workers: int, tries: int,
    address: str | None = None,
) -> list[Done]:  # fmt: skip
    """All trials, once they are over; those of an interrupted search are not computed again.

    Args:
        compute: what a trial comes to; a function of a module.
        search: what is free.
        folder: where Tune keeps its state; with an address, one that every machine sees.
        workers, tries, address: as of :func:`~experiments.sweeping.engines.on_ray`.
    """
    require_extra("ray", "ray", "a search")
    require_extra("optuna", "ray", "a search")
    os.environ |= {
        "TUNE_DISABLE_SIGINT_HANDLER": "1",  # Ctrl-C ends the command, as everywhere
        "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",  # rows are kept in the data set
        "TUNE_GLOBAL_CHECKPOINT_S": "1",  # so much is lost at most where it is killed
        "RAY_AIR_NEW_OUTPUT": "0",  # its output would stand among our tables
    }
    with ray_at(address, workers):
        import optuna
        from ray import tune

        logging.getLogger("ray.tune").setLevel(logging.CRITICAL)  # failures are told at the end
        optuna.logging.set_verbosity(optuna.logging.WARNING)

        def trial(config: dict[str, Any]) -> None:
            tune.report(_reported(compute(proposed(search, config))))

        path = str((folder / _FOLDER).resolve())
        if tune.Tuner.can_restore(path):
            tuner = tune.Tuner.restore(path, trial, restart_errored=True)
        else:
            tuner = _begun(trial, search, folder, workers, tries)
        return [_done(search, found) for found in tuner.fit()]


def _begun(
    trial: Callable[[dict[str, Any]], None], search: Search, folder: Path, workers: int, tries: int
) -> Any:
    """A search that has not begun."""
    from ray import tune
    from ray.tune.search.optuna import OptunaSearch

    return tune.Tuner(
        trial,
        param_space={axis: _space(free) for axis, free in search.free},
        tune_config=tune.TuneConfig(
            metric=_GOAL, mode="max", num_samples=search.trials,
            search_alg=OptunaSearch(seed=_SEED), max_concurrent_trials=workers,
        ),
        run_config=tune.RunConfig(
            name=_FOLDER, storage_path=str(folder.resolve()), verbose=0,
            failure_config=tune.FailureConfig(max_failures=tries - 1),
            callbacks=[_teller(search.trials)],
        ),
    )  # fmt: skip


def _teller(count: int) -> Any:
    """What tells of each trial as it is over."""
    from ray import tune

    class Teller(tune.Callback):  # type: ignore[misc]
        def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **more: Any) -> None:
            before = sum(one.is_finished() for one in trials if one is not trial)
            note(f"trial {before + 1} of {count}: reward {trial.last_result[_GOAL]:.4f}")

    return Teller()


def _space(free: Range | tuple[Any, ...]) -> Any:
    """What is free, as Tune has it: of choices their places, for Optuna takes no lists."""
    from ray import tune

    if isinstance(free, tuple):
        return tune.choice(list(range(len(free))))
    if isinstance(free.low, int) and isinstance(free.high, int):  # Tune leaves out the upper end
        return (tune.lograndint if free.log else tune.randint)(free.low, free.high + 1)
    return (tune.loguniform if free.log else tune.uniform)(free.low, free.high)


def proposed(search: Search, config: Mapping[str, Any]) -> Cell:
    """The training that Tune means, in digits that can be read."""
    free, found = dict(search.free), {}
    for axis, value in config.items():
        of = free[axis]
        if isinstance(of, tuple):
            found[axis] = of[value]
        elif isinstance(value, int):
            found[axis] = value
        else:
            found[axis] = min(max(float(f"{value:.8g}"), of.low), of.high)
    return search.cell(found)


def _done(search: Search, found: Any) -> Done:
    cell = proposed(search, found.config or {})
    if found.error is None:
        return Done(cell, found.metrics, "")
    return Done(cell, None, str(found.error).strip().splitlines()[-1])


def _reported(result: Result) -> dict[str, Any]:
    """A result without its policy, in types that Tune's files have; and what is made great.

    Whoever has found hyperparameters trains with them, on several seeds.
    """
    scores = {metric: np.asarray(of).tolist() for metric, of in result["scores"].items()}
    told = {key: list(value) for key, value in result.items() if key not in ("scores", "policy")}
    keys = [None if key is None else int(key) for key in told["episode_key"]]
    return told | {
        "scores": scores, "episode_key": keys, _GOAL: float(np.mean(scores["reward"])),
    }  # fmt: skip
