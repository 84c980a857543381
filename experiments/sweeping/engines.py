"""Who computes the cells: processes of this machine, or Ray, on this machine or a cluster."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from experiments.evaluation.signals import Ended, ended_by_signals
from experiments.sweeping.cell import Cell
from mmwave_env.lookup import require_extra

Compute = Callable[[Cell], dict[str, Any]]
_AHEAD = 4  # cells handed to each worker before it asks: none of them waits for this process


class Done(NamedTuple):
    """A cell that is over."""

    cell: Cell
    result: dict[str, Any] | None  # of the cell; None where it failed
    error: str  # of the last try


def local(compute: Compute, cells: Sequence[Cell], workers: int, tries: int) -> Iterator[Done]:
    """Cells as they are over, by processes of this machine.

    A worker that is ended from outside costs the cells it had a try, and is replaced.

    Args:
        compute: what to do; a function of a module.
        cells: of which.
        workers: how many processes.
        tries: of each cell before it has failed.
    """
    tried, waiting = dict.fromkeys(cells, 0), list(reversed(cells))
    while waiting:
        running: dict[Future[Any], Cell] = {}
        with _pool(workers) as pool:
            try:
                while waiting or running:
                    while waiting and len(running) < workers * _AHEAD:
                        cell = waiting.pop()
                        tried[cell] += 1
                        running[pool.submit(_ended_cleanly, compute, cell)] = cell
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        cell = running.pop(future)
                        try:
                            yield Done(cell, future.result(), "")
                        except BrokenProcessPool:
                            running[future] = cell
                            raise
                        except Exception as error:
                            if tried[cell] < tries:
                                waiting.append(cell)
                            else:
                                yield Done(cell, None, _told(error))
            except BrokenProcessPool:
                for cell in running.values():
                    if tried[cell] < tries:
                        waiting.append(cell)
                    else:
                        yield Done(cell, None, "its process was ended from outside")


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end with this one; at an interrupt they do not go on with what waits."""
    spawn = multiprocessing.get_context("spawn")  # a fork would share locks
    pool = ProcessPoolExecutor(workers, spawn, _begin)
    try:
        yield pool
    except BaseException:
        for process in list(pool._processes.values()):
            process.terminate()
        with suppress(RuntimeError):  # it was ended before its own thread had begun
            pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown(wait=True, cancel_futures=True)


def _ended_cleanly(compute: Compute, cell: Cell) -> dict[str, Any]:
    """A cell; where the pool ends its process, folders that it made for a while vanish."""
    try:
        with ended_by_signals():
            return compute(cell)
    except Ended as end:
        os._exit(int(str(end.code)))  # or the process would go on with what waits


def _begin() -> None:
    """What a worker does first: leave Ctrl-C to the parent, and end where the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def _told(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


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
        task = ray.remote(num_cpus=1, max_retries=tries - 1, retry_exceptions=True)(compute)
        ahead = max(1, int(ray.cluster_resources().get("CPU", workers))) * _AHEAD
        waiting, running = list(reversed(cells)), dict[Any, Cell]()
        while waiting or running:
            while waiting and len(running) < ahead:
                cell = waiting.pop()
                running[task.remote(cell)] = cell
            (one,), _ = ray.wait(list(running), num_returns=1)
            cell = running.pop(one)
            try:
                yield Done(cell, ray.get(one), "")
            except ray.exceptions.RayError as error:
                yield Done(cell, None, _told(getattr(error, "cause", None) or error))


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
        yield ray
    finally:
        ray.shutdown()


def _packages() -> list[str]:
    """Folders of the packages that workers need, for those who have not installed them."""
    names = ("mmwave_env", "policies", "experiments")
    return [str(Path(str(import_module(name).__file__)).parent) for name in names]
