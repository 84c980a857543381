"""Computation of a sweep's cells with Ray, on this machine or on a cluster."""

import itertools
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from experiments.console.signals import ended_by_signals
from experiments.sweeping.spec import Values
from mmwave_env.io.files import first_line

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
