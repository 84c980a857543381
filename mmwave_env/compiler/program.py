"""Programs: functions of numbers, compiled to run epoch after epoch for many environments.

A *workspace* is a tree of all numbers that a program reads and writes for one environment. The
program is a function from a workspace to the workspace one epoch later. Workspaces are stored in
an array (blocks, rows, 8): a block has eight environments, and a row for each number of the tree.
Before each epoch, the field ``incoming`` of a workspace is set from a table or by a :class:`Feed`.
A *track* is the sequence of epochs that one environment filters, with one workspace. Threads run
blocks in parallel, because compiled code releases Python's lock.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numba import typeof, types
from numba.core.compiler_lock import global_compiler_lock
from numpy.typing import NDArray

from mmwave_env.compiler.advance import advance
from mmwave_env.compiler.disk_cache import compiled_callback
from mmwave_env.compiler.lanes import WIDTH, kernel
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.numerics.pytree import flatten, indices, unflatten
from mmwave_env.numerics.tape import fingerprint

Columns = tuple[Index, dict[str, int | slice]]  # rows, and the output columns of parts of them
Workspace = TypeVar("Workspace", bound=tuple[Any, ...])
Result = TypeVar("Result")

NO_ROWS = np.empty(0, np.int64)


@lru_cache(maxsize=1)
def _helpers() -> ThreadPoolExecutor:
    """Return the threads that work on jobs together with the thread that calls :func:`share`."""
    return ThreadPoolExecutor(os.cpu_count(), "mmwave-env")


# numba holds a lock while it compiles. A child that is forked meanwhile would wait forever for the
# lock, because the child lacks the thread that releases it. So a fork first waits for the lock.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=global_compiler_lock.acquire,
        after_in_parent=global_compiler_lock.release,
        after_in_child=global_compiler_lock.release,
    )
    # a forked child has only the thread that forked
    os.register_at_fork(after_in_child=_helpers.cache_clear)


def rows_of(tree: Any) -> Index:
    """Return the row numbers in a tree, such as a part of :attr:`Program.index`."""
    return np.array(flatten(tree), np.int64)


def laid_out(parts: Mapping[str, Any]) -> Columns:
    """Return the row numbers of parts of a :attr:`Program.index`, and each part's output columns.

    Output arrays have one column for each of these rows, in order. A part's columns are a slice, or
    a number if the part is a single number.
    """
    columns: dict[str, int | slice] = {}
    first = 0
    for name, part in parts.items():
        width = len(flatten(part))
        columns[name] = first if isinstance(part, int) else slice(first, first + width)
        first += width
    return rows_of(list(parts.values())), columns


def blocks_of(start: Array, n: int) -> Array:
    """Return workspaces (blocks, size, 8) for n tracks; every lane is a copy of start (size,)."""
    return np.tile(start[None, :, None], (-(-n // WIDTH), 1, WIDTH))


def fill(blocks: Array, rows: Index, values: Array) -> Array:
    """Set some rows (k,) of blocks (blocks, size, 8) to the values (n, k) of n tracks."""
    block, lane = np.divmod(np.arange(len(values)), WIDTH)
    blocks[block[:, None], rows, lane[:, None]] = values
    return blocks


class Feed(NamedTuple):
    """A function that replaces the table of epochs: it computes the incoming rows of every epoch.

    A feed has its own workspaces. A track has the same block and lane there as in the program's.
    """

    # address of a C function, whose arguments are three addresses: incoming rows, settings, kept
    run: int
    settings: Array  # (rows, 8) read only, the same for all blocks
    kept: Array  # (blocks, rows, 8) the feed's workspace, changed in place

    @classmethod
    def none(cls) -> "Feed":
        """Return an empty feed, with address 0, to use when there is a table."""
        return cls(0, np.empty((0, WIDTH)), np.empty((0, 0, WIDTH)))


class BatchState(NamedTuple):
    """The workspaces of n tracks, their epochs, and the index of each track's next epoch."""

    rows: Array  # (blocks, size, 8) the workspaces, changed in place
    feed: Feed  # computes the incoming rows if there is no table
    table: Array  # (n, epochs, incoming) the epochs to load
    length: Index  # (n,) number of epochs of each track; after the last, a blank epoch is loaded
    epoch: Index  # (n,) index of the epoch that each track runs next, changed in place

    @classmethod
    def of(cls, table: Array, rows: Array) -> "BatchState":
        """Return the state of tracks of equal length, at their first epoch."""
        n, epochs, _ = table.shape
        return cls(rows, Feed.none(), table, np.full(n, epochs), np.zeros(n, np.int64))


class StepIO(NamedTuple):
    """The inputs and outputs of workspaces in each of the E epochs of a run."""

    input_rows: Index  # (f,) rows to set before an epoch
    inputs: Array  # (n, E, f) values of these rows
    output_rows: Index  # (k,) rows to copy to ``outputs`` after an epoch
    outputs: Array  # (n, E, k) values of these rows
    obs_rows: Index  # (s,) rows to copy to ``observations`` after an epoch
    observations: NDArray[np.float32]  # (n, E, s) values in single precision

    @classmethod
    def of(
        cls,
        n: int,
        epochs: int,
        input_rows: Index = NO_ROWS,
        output_rows: Index = NO_ROWS,
        obs_rows: Index = NO_ROWS,
    ) -> "StepIO":
        """Return zeros as inputs, and empty arrays for outputs and observations."""
        inputs = np.zeros((n, epochs, len(input_rows)))
        outputs = np.empty((n, epochs, len(output_rows)))
        observations = np.empty((n, epochs, len(obs_rows)), np.float32)
        return cls(input_rows, inputs, output_rows, outputs, obs_rows, observations)


class Stages(NamedTuple):
    """The programs of an epoch, between which a compiled policy acts and corrects n tracks.

    Attributes:
        runs: addresses of the programs that filter, decide and correct.
        io: their inputs and outputs, of one epoch.
        blank: as for :func:`~mmwave_env.compiler.advance.advance`.
        states: the state to filter the next epoch; and to go on with that epoch.
    """

    runs: tuple[int, ...]
    io: StepIO
    blank: Array
    states: tuple[BatchState, BatchState]


class Program(Generic[Workspace]):
    """A function of numbers, compiled or read from disk at its first use, and its workspace.

    Args:
        function: maps a workspace tree to a workspace tree of the same shape.
        template: the initial workspace, of floats. Its ``incoming`` is the blank epoch, which is
            run if a track has no epoch left.
    """

    def __init__(self, function: Callable[[Workspace], Workspace], template: Workspace) -> None:
        self.function = function
        self.template = template
        self.start = np.array(flatten(template), float)
        self.blank = np.array(flatten(template[0]), float)
        self.index: Workspace = indices(template)
        self._compiled: Any = None
        self._columns: dict[Sequence[str], Columns] = {}

    def rows(self, names: Sequence[str]) -> Index:
        """Return the row numbers of parts of ``index``, such as "x", "memory.nis" or "x P"."""
        return self._found(tuple(names))[0]

    def by_name(self, names: Sequence[str], outputs: Array) -> dict[str, Array]:
        """Split outputs (n, epochs, columns) by name; column i is row ``self.rows(names)[i]``.

        A part is (n, epochs) if it is a single number, (n, epochs, k) if it has k numbers.
        """
        return {
            name: outputs[..., columns] for name, columns in self._found(tuple(names))[1].items()
        }

    def _found(self, names: tuple[str, ...]) -> Columns:
        """Return :func:`laid_out` for the parts with these names."""
        if names not in self._columns:
            parts = {name: attrgetter(*name.split())(self.index) for name in names}
            self._columns[names] = laid_out(parts)
        return self._columns[names]

    def run_on_lanes(self, state: BatchState, io: StepIO, threads: int = 1) -> None:
        """Run epoch after epoch, eight environments at a time, on at most ``threads`` threads."""
        blocks = len(state.rows)
        jobs = [
            (*part, self.on_lanes(), self.blank, state, io)
            for part in spans(blocks, min(threads, blocks))
        ]
        share(advance, jobs, threads)

    def run_on_floats(self, begin: int, end: int, state: BatchState, io: StepIO) -> None:
        """Run the tracks of some blocks one by one in plain Python: slow, for reference."""
        for e in range(begin * WIDTH, min(end * WIDTH, len(state.epoch))):
            lanes = state.rows[e // WIDTH, :, e % WIDTH]
            for step in range(io.outputs.shape[1]):
                t = state.epoch[e] + step
                # Epochs come from the table, because feeds only run on lanes.
                incoming = state.table[e, t] if t < state.length[e] else self.blank
                lanes[: len(self.blank)] = incoming
                lanes[io.input_rows] = io.inputs[e, step]
                lanes[:] = flatten(self.function(unflatten(self.template, iter(lanes.tolist()))))
                io.outputs[e, step] = lanes[io.output_rows]
                io.observations[e, step] = lanes[io.obs_rows]
            state.epoch[e] += io.outputs.shape[1]

    def on_lanes(self) -> int:
        """Return the address of a C function that runs the program on a block.

        The function is compiled here, once, and kept with the program; ``advance.call`` calls it.
        Loops take the address as an argument, so a loop is not compiled anew for every program. The
        address is a number because a ctypes pointer would cost each call a microsecond of Python.
        """
        if self._compiled is None:  # every step comes here, and this test is cheaper than the lock
            with global_compiler_lock:
                if self._compiled is None:
                    self._compiled = self._compile()
        return self._compiled.address  # type: ignore[no-any-return]

    def _compile(self) -> Any:
        run = kernel(self.function, self.template)

        def on_address(address):  # type: ignore[no-untyped-def]
            run((address,))

        on_address.__qualname__ = f"Program.{fingerprint(self.function, self.template)}"
        return compiled_callback(types.void(types.int64), on_address)


def share(
    function: Callable[..., Result], jobs: Sequence[tuple[Any, ...]], threads: int
) -> list[Result]:
    """Return the result of ``function(*job)`` for every job, in order.

    At most ``threads`` threads, including the calling thread, work in parallel. After an error or
    interrupt, no further job begins; the exception is raised once the running jobs have ended.
    """
    if threads == 1 or len(jobs) == 1:
        return [function(*job) for job in jobs]
    results: list[Any] = [None] * len(jobs)
    waiting = iter(range(len(jobs)))  # shared by the threads: next() is atomic

    def work() -> None:
        for i in waiting:
            results[i] = function(*jobs[i])

    others: list[Future[None]] = []
    try:
        others.extend(_helpers().submit(work) for _ in range(min(threads, len(jobs)) - 1))
        work()
    finally:
        for _ in waiting:  # take the remaining jobs, so that no thread begins another one
            pass
        running = [other for other in others if not other.cancel()]
        wait(running)
    for other in running:
        other.result()
    return results


def spans(count: int, parts: int) -> list[tuple[int, int]]:
    """Split ``count`` things into ``parts`` nearly equal parts; return each part's (first, end)."""
    return list(pairwise(count * i // parts for i in range(parts + 1)))


class Repeated:
    """A :func:`compiled` loop over ranges of things, with the same types in every call.

    After the first call, numba's check of types, which takes microseconds, is skipped.
    """

    def __init__(self, function: Any) -> None:
        self._function = function
        self._unchecked: Callable[..., Any] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Repeated, (self._function,)  # the function's machine code can't be pickled

    def __call__(
        self, parts: Sequence[tuple[int, int]], threads: int, *arguments: Any
    ) -> list[Any]:
        """Run the ranges on at most ``threads`` threads; return the results, in order."""
        jobs = [(*part, *arguments) for part in parts]
        results = share(self._unchecked or self._function, jobs, threads)
        if self._unchecked is None:
            kinds = tuple(map(typeof, jobs[0]))
            self._unchecked = self._function.overloads[kinds].entry_point
        return results
