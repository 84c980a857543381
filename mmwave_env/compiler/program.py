"""A function of numbers, compiled to run epoch after epoch for many environments.

A program maps a workspace tree to a workspace tree. Its leaves are rows of an array
(blocks, rows, 8), eight environments to a block. The first field of a workspace,
``incoming``, is loaded before each run from a table of whole tracks.
"""

import ctypes
import os
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Any, Generic, NamedTuple, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic, overload, register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.disk_cache import compiled_callback
from mmwave_env.compiler.fingerprint import fingerprint
from mmwave_env.compiler.lanes import WIDTH, kernel
from mmwave_env.compiler.lazy_jit import LazyJit
from mmwave_env.compiler.transpose import LINE, address, gather, prefetch, scatter, scatter_single
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.numerics.pytree import Tree, flatten, indices, unflatten

Workspace = TypeVar("Workspace", bound=tuple[Any, ...])
Blocks = tuple[int, int]  # first, end

NO_ROWS = np.empty(0, np.int64)
PLAIN_BLOCK_EPOCHS = 1000  # of blocks, before compiling, which takes as long as 4000 of them
NEAR = 2**16  # numbers that the core's own caches hold of workspaces

# numba's own lock guards all that compiles. A child forked while another thread holds it would
# wait for ever, for that thread is not in the child; so a fork waits for the compilation.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=global_compiler_lock.acquire,
        after_in_parent=global_compiler_lock.release,
        after_in_child=global_compiler_lock.release,
    )


def rows_of(tree: Any) -> Index:
    """The numbers of rows in a tree, as of parts of :attr:`Program.index`."""
    return np.array(flatten(tree), np.int64)


class BatchState(NamedTuple):
    """N tracks and how far they are."""

    rows: Array  # (blocks, size, 8) workspace, changed in place
    table: Array  # (n, epochs, incoming) what to load
    length: Index  # (n,) epochs there are of each track; past them a blank one is loaded
    epoch: Index  # (n,) the epoch each runs next, changed in place
    running: NDArray[np.bool_]  # (n,) False leaves a track and its epoch as they are

    @classmethod
    def of(cls, table: Array, rows: Array) -> "BatchState":
        """Tracks of equal length, from their first epoch."""
        n, epochs, _ = table.shape
        return cls(rows, table, np.full(n, epochs), np.zeros(n, np.int64), np.ones(n, np.bool_))


class StepIO(NamedTuple):
    """What goes in and out of workspaces in every epoch of a run of E epochs."""

    input_rows: Index  # (f,) rows to set before an epoch
    inputs: Array  # (n, E, f) their values
    output_rows: Index  # (k,) rows to keep after an epoch
    outputs: Array  # (n, E, k) gets them
    obs_rows: Index  # (s,) rows to keep in single precision
    observations: NDArray[np.float32]  # (n, E, s) gets them

    @classmethod
    def of(
        cls,
        n: int,
        epochs: int,
        input_rows: Index = NO_ROWS,
        output_rows: Index = NO_ROWS,
        obs_rows: Index = NO_ROWS,
    ) -> "StepIO":
        """Zeros as inputs, and room for outputs and observations."""
        return cls(
            input_rows, np.zeros((n, epochs, len(input_rows))),
            output_rows, np.empty((n, epochs, len(output_rows))),
            obs_rows, np.empty((n, epochs, len(obs_rows)), np.float32),
        )  # fmt: skip


def tree_kernel(function: Callable[[Tree], Tree], template: Tree) -> Any:
    """A numba function of a (rows, 8) block that changes it by a function of numbers.

    Args:
        function: from a tree to a tree of the same shape.
        template: a tree of that shape; its leaves in order are the rows.
    """

    def build(rows: Any) -> None:
        before = [rows[i] for i in range(len(flatten(template)))]
        after = flatten(function(unflatten(template, iter(before))))
        for i, (old, new) in enumerate(zip(before, after, strict=True)):
            if new is not old:
                rows[i] = new

    return kernel(build)


def c_function(signature: Any, function: Callable[..., Any]) -> Any:
    """A function, compiled, as an argument for compiled functions.

    Its arguments and what it returns are addresses and 64-bit integers, or nothing; its name tells
    what it does, as of :func:`~mmwave_env.compiler.disk_cache.compiled_callback`.
    """
    kinds: dict[Any, Any] = {
        types.voidptr: ctypes.c_void_p,
        types.int64: ctypes.c_int64,
        types.void: None,
    }
    callback = compiled_callback(signature, function)
    takes = [kinds[kind] for kind in signature.args]
    pointer: Any = ctypes.CFUNCTYPE(kinds[signature.return_type], *takes)(callback.address)
    pointer.code = callback  # which lives as long
    return pointer


def call(run: int, block: Array) -> None:
    """Run a program on a block (size, 8), by the address that ``Program.on_lanes`` returns."""
    ctypes.CFUNCTYPE(None, ctypes.c_void_p)(run)(block.ctypes)


@overload(call)  # type: ignore[untyped-decorator]
def _compiled_call(run, block):  # type: ignore[no-untyped-def]
    return lambda run, block: _jump(run, block.ctypes.data)


@intrinsic  # type: ignore[untyped-decorator]
def _jump(_, run, block):  # type: ignore[no-untyped-def]
    def build(context, builder, signature, addresses):  # type: ignore[no-untyped-def]
        function = ir.FunctionType(ir.VoidType(), [addresses[1].type])
        builder.call(builder.inttoptr(addresses[0], function.as_pointer()), [addresses[1]])
        return context.get_dummy_value()

    return types.void(run, block), build


class Program(Generic[Workspace]):
    """A function of numbers with its workspace, compiled or found on disk when lanes first run.

    Args:
        function: from a workspace tree to a workspace tree of the same shape.
        template: a workspace of floats, the initial value; its ``incoming`` is the blank epoch.
    """

    def __init__(self, function: Callable[[Workspace], Workspace], template: Workspace) -> None:
        self.function, self.template = function, template
        self.start = np.array(flatten(template), float)
        self.blank = np.array(flatten(template[0]), float)
        self.size = len(self.start)
        self.index: Workspace = indices(template)
        self._compiled: Any = None

    def parts(self, names: Sequence[str]) -> list[Any]:
        """Parts of ``index`` by name, such as "x" or "memory.nis"."""
        return [attrgetter(name)(self.index) for name in names]

    def by_name(self, names: Sequence[str], outputs: Array) -> dict[str, Array]:
        """What was kept (n, epochs, rows) of the rows of :meth:`parts`, taken apart.

        Returns:
            Per name (n, epochs) of a single number, else (n, epochs, numbers).
        """
        result, first = {}, 0
        for name, part in zip(names, self.parts(names), strict=True):
            width = len(flatten(part))
            columns = outputs[..., first : first + width]
            result[name] = columns[..., 0] if isinstance(part, int) else columns
            first += width
        return result

    def run_on_lanes(self, state: BatchState, io: StepIO, blocks: Blocks | None = None) -> None:
        """Run epoch after epoch, eight environments at a time, in some of the blocks or all."""
        first, end = blocks or (0, len(state.rows))
        epochs = (end - first) * io.outputs.shape[1]
        _advance(epochs, first, end, self.on_lanes(), self.blank, *state, *io)

    def run_on_floats(self, state: BatchState, io: StepIO) -> None:
        """Run all, one environment at a time in plain Python: slow, for reference."""
        rows, table, length, epoch, running = state
        input_rows, inputs, output_rows, outputs, obs_rows, observations = io
        for e in np.flatnonzero(running):
            lanes = rows[e // WIDTH, :, e % WIDTH]
            for step in range(outputs.shape[1]):
                t = epoch[e] + step
                lanes[: len(self.blank)] = table[e, t] if t < length[e] else self.blank
                lanes[input_rows] = inputs[e, step]
                lanes[:] = self.once(lanes)
                outputs[e, step], observations[e, step] = lanes[output_rows], lanes[obs_rows]
            epoch[e] += outputs.shape[1]

    def once(self, workspace: Array) -> list[float]:
        """The leaves (size,) after one run on floats."""
        return flatten(self.function(unflatten(self.template, iter(workspace.tolist()))))

    def on_lanes(self) -> int:
        """The address of a C function that runs the program on a block, for :func:`call`.

        It is compiled here, once, and lives as long as the program. Loops around it take it as an
        argument and so need no compilation of their own for every program; a number, because a
        pointer of ctypes costs each call a microsecond of Python.
        """
        if self._compiled is None:  # the lock costs more than a look, and many steps come
            with global_compiler_lock:
                if self._compiled is None:
                    self._compiled = self._compile()
        return self._compiled.address  # type: ignore[no-any-return]

    def _compile(self) -> Any:
        run, shape = tree_kernel(self.function, self.template), (self.size, WIDTH)

        def on_address(address):  # type: ignore[no-untyped-def]
            run(numba.carray(address, shape, np.float64))

        on_address.__qualname__ = f"Program.{fingerprint(self.function, self.template)}"
        return compiled_callback(types.void(types.voidptr), on_address)


@register_jitable  # type: ignore[untyped-decorator]
def _load(block, sources, first, here, step, blank, table, length, epoch, input_rows, inputs):  # type: ignore[no-untyped-def]
    """Set the rows that come in; lanes past the last track run their block's first."""
    for lane in range(WIDTH):
        e = first + lane if lane < here else first
        t = epoch[e] + step
        sources[lane] = address(table, e, t) if t < length[e] else blank.ctypes.data
        for i in range(len(input_rows)):
            block[input_rows[i], lane] = inputs[e, step, i]
    gather(block, sources, len(blank))


@register_jitable  # type: ignore[untyped-decorator]
def _aim(targets, first, here, step, running, out, nowhere):  # type: ignore[no-untyped-def]
    """Where lanes write to; those of no track that runs, where nobody looks."""
    for lane in range(WIDTH):
        e = first + lane
        runs = lane < here and running[e]
        targets[lane] = address(out, e, step) if runs else nowhere.ctypes.data


@register_jitable  # type: ignore[untyped-decorator]
def _announce(first, end, table, length, epoch):  # type: ignore[no-untyped-def]
    """Prefetch the next epochs of some tracks into the caches."""
    for e in range(first, end):
        if epoch[e] < length[e]:
            for byte in range(0, table.strides[1], LINE):
                prefetch(address(table, e, epoch[e]) + byte)


@register_jitable  # type: ignore[untyped-decorator]
def advance(  # type: ignore[no-untyped-def]
    begin, end, run, blank, rows, table, length, epoch, running, input_rows, inputs,
    output_rows, outputs, obs_rows, observations,
):  # fmt: skip
    """Run the tracks of blocks ``begin`` to ``end``.

    Ignore the number that is returned. It is there because the compiler would otherwise drop the
    reads that bring rows into the caches.

    A program reads its rows in an order that no prefetcher guesses. Where the blocks of all
    environments do not fit into the near caches, touching the rows in order first halves its time.
    The epochs that the next block will load are as far apart as episodes are long.
    Plain loops, because slices of arrays take numba long to compile.
    """
    n, epochs, size = len(length), outputs.shape[1], rows.shape[1]
    before = np.empty((size, WIDTH))
    at, nowhere = np.empty(WIDTH, np.int64), np.empty(max(len(output_rows), len(obs_rows)))
    touched = 0.0
    for b in range(begin, end):
        block, first = rows[b], b * WIDTH
        here = min(WIDTH, n - first)
        busy = 0
        for e in range(first, first + here):
            busy += running[e]
        if busy == 0:
            continue
        if rows.size > NEAR:
            for i in range(size):
                touched = max(touched, block[i, 0])
        _announce(first + here, min(first + here + WIDTH, end * WIDTH, n), table, length, epoch)
        if busy < here:
            for i in range(size):
                for lane in range(WIDTH):
                    before[i, lane] = block[i, lane]
        for step in range(epochs):
            _load(block, at, first, here, step, blank, table, length, epoch, input_rows, inputs)
            call(run, block)
            _aim(at, first, here, step, running, outputs, nowhere)
            scatter(block, output_rows, at)
            _aim(at, first, here, step, running, observations, nowhere)
            scatter_single(block, obs_rows, at)
        for lane in range(here):
            if running[first + lane]:
                epoch[first + lane] += epochs
                continue
            for i in range(size):
                block[i, lane] = before[i, lane]
    return touched


_advance = LazyJit(advance, PLAIN_BLOCK_EPOCHS)
