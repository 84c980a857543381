"""A process of this machine that computes cells, one after the other."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress

from experiments.evaluation.signals import Ended, ended_by_signals
from experiments.sweeping.cell import Cell, Compute, Result


class Worker:
    """A process, and the cells it was handed, in their order.

    It is alone in its pool: where the process ends, the first of its cells that is not over is the
    one that was under way, and nobody else has lost anything.

    Args:
        compute: what to do; a function of a module.
    """

    def __init__(self, compute: Compute) -> None:
        self._compute, self._pool = compute, _pool_of_one()
        self.handed: dict[Future[Result], Cell] = {}

    def hand(self, cell: Cell) -> bool:
        """Give it a cell for when the others are over; False where its process has just ended."""
        try:
            self.handed[self._pool.submit(_ended_cleanly, self._compute, cell)] = cell
        except BrokenProcessPool:
            if not self.handed:  # otherwise the first of them tells
                self.renew()
            return False
        return True

    def over(self) -> Iterator[tuple[Cell, Future[Result]]]:
        """Cells that are over since the last call, the one with which the process ended as last."""
        while self.handed and (future := next(iter(self.handed))).done():
            yield self.handed.pop(future), future

    def renew(self) -> list[Cell]:
        """Begin a process in place of one that has ended; cells that it had not begun."""
        self.end()
        self._pool, unbegun = _pool_of_one(), list(self.handed.values())
        self.handed.clear()
        return unbegun

    def end(self) -> None:
        """End the process, also within a cell."""
        for process in list((self._pool._processes or {}).values()):
            process.terminate()
        with suppress(RuntimeError):  # this process is ended before the pool's thread had begun
            self._pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def staff_of(compute: Compute, count: int) -> Iterator[list[Worker]]:
    """Workers that end with this; at an interrupt they do not go on with what waits."""
    staff = [Worker(compute) for _ in range(count)]
    try:
        yield staff
    finally:
        for worker in staff:
            worker.end()


def _pool_of_one() -> ProcessPoolExecutor:
    spawn = multiprocessing.get_context("spawn")  # a fork would share locks
    return ProcessPoolExecutor(1, spawn, _begin)


def _ended_cleanly(compute: Compute, cell: Cell) -> Result:
    """A cell; where this process is ended, folders that it made for a while vanish."""
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
