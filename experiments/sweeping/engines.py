"""Who computes the cells: processes of this machine, or Ray, on this machine or a cluster."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from experiments.console.signals import ended_by_signals
from experiments.sweeping.cell import Cell, Compute, Done
from experiments.sweeping.worker import Worker, staff_of
from mmwave_env.lookup import require_extra

_AHEAD = 4  # cells that Ray has for each worker: none of them waits for this process


def local(compute: Compute, cells: Sequence[Cell], workers: int, tries: int) -> Iterator[Done]:
    """Cells as they are over, by processes of this machine.

    A worker that is ended from outside costs the cell it was at a try, and is replaced.

    Args:
        compute: what to do; a function of a module.
        cells: of which.
        workers: how many processes.
        tries: of each cell before it has failed.
    """
    tried, waiting = Counter[Cell](), list(reversed(cells))
    with staff_of(compute, min(workers, len(cells))) as staff:
        while waiting or any(worker.handed for worker in staff):
            _hand_out(waiting, staff)
            ready = wait([worker.pipe for worker in staff if worker.handed])
            for worker in [one for one in staff if one.pipe in ready]:
                cell, (result, error), unbegun = worker.answer()
                waiting += unbegun
                tried[cell] += 1
                if result is None and tried[cell] < tries:
                    waiting.append(cell)
                else:
                    yield Done(cell, result, error)


def _hand_out(waiting: list[Cell], staff: Sequence[Worker]) -> None:
    """A cell for everybody; while many wait a second, so that nobody waits for this process."""
    for least, ahead in ((0, 1), (len(staff), 2)):
        for worker in staff:
            if len(waiting) > least and len(worker.handed) < ahead:
                worker.hand(waiting.pop())


def on_ray(
    compute: Compute, cells: Sequence[Cell], workers: int, tries: int, address: str | None = None
) -> Iterator[Done]:
    """The same by Ray, which hands out, tries again and brings back by its own means.

    Args:
        compute, cells, tries: as of :func:`local`.
        workers: how many processes, where no address says who there is.
        address: of a cluster, which gets the code by Ray, too; None for this machine alone.
    """
    with ray_at(address, workers) as ray:
        # Tries are counted here, for Ray does not count those that ran out of memory.
        task = ray.remote(num_cpus=1, max_retries=0)(compute)
        ahead = max(1, int(ray.cluster_resources().get("CPU", workers))) * _AHEAD
        tried, waiting, running = Counter[Cell](), list(reversed(cells)), dict[Any, Cell]()
        while waiting or running:
            while waiting and len(running) < ahead:
                cell = waiting.pop()
                running[task.remote(cell)] = cell
            (one,), _ = ray.wait(list(running), num_returns=1)
            cell = running.pop(one)
            tried[cell] += 1
            try:
                done = Done(cell, ray.get(one), "")
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                done = Done(cell, None, f"{type(cause).__name__}: {cause}")
            if done.result is None and tried[cell] < tries:
                waiting.append(cell)
            else:
                yield done


@contextmanager
def ray_at(address: str | None, workers: int) -> Iterator[Any]:
    """The module ``ray``, with its workers until this ends; arguments as of :func:`on_ray`."""
    require_extra("ray", "ray", "engine ray")
    import ray

    where: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False}
    if address is not None:
        where = {"address": address, "runtime_env": {"py_modules": _packages()}}
    ray.init(log_to_driver=False, logging_level="error", **where)
    try:
        with ended_by_signals():  # Ray has just put handlers of its own in their place
            yield ray
    finally:
        ray.shutdown()


def _packages() -> list[str]:
    """Folders of the packages that workers need, for those who have not installed them."""
    names = ("mmwave_env", "policies", "experiments")
    return [str(Path(str(import_module(name).__file__)).parent) for name in names]
