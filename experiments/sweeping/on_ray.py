"""Computation of a sweep's cells and trials with Ray, on this machine or on a cluster."""

import itertools
import logging
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from experiments.console.signals import ended_by_signals
from experiments.sweeping.spec import Spec, Values
from mmwave_env.io.files import first_line
from mmwave_env.metrics import METRICS

RETRIES = 2  # maximum repeats of a cell whose process ran out of memory, ended, or raised OSError
AHEAD = 1000  # maximum number of cells submitted to Ray at a time; also limits busy workers
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_task_oom_retries": str(RETRIES),  # unlimited by default
    "RAY_agent_register_timeout_ms": "120000",  # Ray starts slowly on a busy machine
    "RAY_AIR_NEW_OUTPUT": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",  # paths are relative to the command's folder
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # Ctrl-C must end the command
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",  # a sweep stores only rows
}
# at 1/9 and 1/3 of the timesteps, only the best third of the trials goes on
RUNGS = 9
SHARE = 3


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
    ray.init(**options)
    try:
        # Replace the signal handlers that Ray has just installed, and hide what Ray prints.
        with ended_by_signals(), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            yield
    finally:
        ray.shutdown()


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


def searched(
    train: Callable[[Values, Callable[[Values], None]], Values],
    spec: Spec,
    before: Mapping[str, Values],
    keep: Callable[[str, Values, Values], None],
) -> list[str]:
    """Run a search's remaining trials on Ray Tune, with Optuna's sampler and early stopping.

    Return the errors of failed trials.

    Args:
        train: function that trains with given values, and calls its second argument with a row
            for every evaluation.
        before: rows of finished trials, from which the sampler learns.
        keep: function called with the name of a finished trial, its values and its last row.
    """
    import optuna
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler
    from ray.tune.search.optuna import OptunaSearch

    columns = ("timesteps", *(f"{metric}_mean" for metric in METRICS))

    class Keeper(tune.Callback):  # type: ignore[misc]
        def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **more: Any) -> None:
            row = {column: trial.last_result[column] for column in columns}
            keep(f"{spec.trial}-{trial.trial_id}", spec.values_of(trial.config), row)

    def trial(proposal: Values) -> None:
        train(spec.values_of(proposal), tune.report)

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    (most,) = spec.axes["total_timesteps"]
    goal: dict[str, Any] = {"metric": "reward_mean", "mode": "max"}
    sampler = OptunaSearch(
        dict(spec.free),
        **goal,
        seed=len(before),
        points_to_evaluate=[{axis: row[axis] for axis in spec.free} for row in before.values()],
        evaluated_rewards=[row["reward_mean"] for row in before.values()],
    )
    stopping = ASHAScheduler(
        "timesteps", max_t=most, grace_period=max(1, most // RUNGS), reduction_factor=SHARE
    )
    tuning = tune.TuneConfig(
        **goal, num_samples=spec.trials - len(before), search_alg=sampler, scheduler=stopping
    )
    retries = tune.FailureConfig(max_failures=RETRIES)
    with tempfile.TemporaryDirectory() as folder:
        running = tune.RunConfig(
            storage_path=folder, verbose=0, callbacks=[Keeper()], failure_config=retries
        )
        trials = tune.Tuner(trial, tune_config=tuning, run_config=running).fit()
    return [str(error).strip().splitlines()[-1] for error in trials.errors]
