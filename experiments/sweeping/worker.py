"""A process of this machine that computes cells, one after the other."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import NamedTuple

from experiments.console.signals import Ended, ended_by_signals, ignored
from experiments.sweeping.cell import Cell, Compute, Result

_PATIENCE_S = 5.0  # for a process that was asked to end: it may be in C code that never looks up


class Answer(NamedTuple):
    """What a worker came to with a cell."""

    result: Result | None  # None where it failed
    error: str


class Worker:
    """A process, and the cells it was handed, in their order.

    It has a pipe of its own, whose other end nobody else holds: where the process ends, also
    within an answer, the pipe says so, and the first of the cells is the one that was under way.

    Args:
        compute: what to do; a function of a module.

    Attributes:
        handed: cells that are not over.
        pipe: readable where a cell is over, or the process.
    """

    def __init__(self, compute: Compute) -> None:
        self._compute, self.handed = compute, list[Cell]()
        self._begin()

    def _begin(self) -> None:
        """Have a process that was handed nothing."""
        spawn = multiprocessing.get_context("spawn")  # a fork would share locks and pipes
        self.pipe, its = spawn.Pipe()
        self._process = spawn.Process(target=_serve, args=(its, self._compute))
        self._process.start()
        its.close()

    def hand(self, cell: Cell) -> None:
        """Give it a cell for when the others are over."""
        try:
            self.pipe.send(cell)
        except OSError:  # the process has ended, as its next answer will tell
            if not self.handed:  # but there is none to come
                self._renew()
                self.pipe.send(cell)
        self.handed.append(cell)

    def answer(self) -> tuple[Cell, Answer, list[Cell]]:
        """The next cell that is over; waits for it.

        Returns:
            The cell, its answer, and cells that it has not begun because the process ended; then
            it has begun another.
        """
        try:
            answer = Answer(*self.pipe.recv())
            return self.handed.pop(0), answer, []
        except (EOFError, OSError):
            cell, *unbegun = self.handed
            self.handed.clear()
            self._renew()
            return cell, Answer(None, "its process was ended from outside"), unbegun

    def _renew(self) -> None:
        self.end()
        self._begin()

    def ask_to_end(self) -> None:
        """End the process soon, also within a cell."""
        self._process.terminate()

    def end(self) -> None:
        """End the process, if need be at once."""
        self.ask_to_end()
        self._process.join(_PATIENCE_S)
        self._process.kill()
        self._process.join()
        self.pipe.close()


@contextmanager
def staff_of(compute: Compute, count: int) -> Iterator[list[Worker]]:
    """Workers that end with this, whatever they are at; a second Ctrl-C can't leave them behind."""
    staff = list[Worker]()
    try:
        staff.extend(Worker(compute) for _ in range(count))
        yield staff
    finally:
        with ignored():
            for worker in staff:
                worker.ask_to_end()
            for worker in staff:
                worker.end()


def _serve(pipe: Connection, compute: Compute) -> None:
    """What the process does: compute what comes until nobody asks any more.

    Ctrl-C is left to the parent. Where this process is ended, folders that a cell made for a while
    vanish.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _follow_parent()
    while True:
        try:
            cell = pipe.recv()
        except EOFError:
            return
        try:
            with ended_by_signals():
                answer = Answer(compute(cell), "")
        except Ended as end:
            os._exit(int(str(end.code)))
        except Exception as error:
            answer = Answer(None, f"{type(error).__name__}: {error}")
        pipe.send(tuple(answer))


def _follow_parent() -> None:
    """End where the parent is gone, also within a cell."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
