"""The loop that runs a compiled program for many tracks, epoch by epoch, eight tracks at a time.

The numbers of eight tracks form a *block*: an array in which each track has one column, its *lane*.
In each epoch, a block's *incoming* rows (the epoch's data) are loaded from a table, or a *feed* (a
compiled function) computes them. Results are written to arrays. The loop also runs as plain Python.
"""

import ctypes

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload, register_jitable

from mmwave_env.compiler.lanes import WIDTH, address, gather, scatter, scatter_single

NEAR = 2**16  # if all blocks together have up to this many numbers, a core's own caches hold them
TOGETHER = 8  # a feed runs for this many blocks, and then the program runs for the same blocks


def call(run: int, places: tuple[int, ...]) -> None:
    """Call the C function at the address ``run`` with the addresses of arrays.

    ``Program.on_lanes`` returns the address of a program, whose argument is a block (size, 8);
    ``program.Feed`` describes the arguments of a feed.
    """
    ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * len(places))(run)(*places)


@overload(call)  # type: ignore[untyped-decorator]
def _compiled_call(run, places):  # type: ignore[no-untyped-def]
    return lambda run, places: _jump(run, places)  # noqa: PLW0108 - numba compiles it


@intrinsic  # type: ignore[untyped-decorator]
def _jump(_, run, addresses):  # type: ignore[no-untyped-def]
    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        target, packed = arguments
        each = [builder.extract_value(packed, i) for i in range(len(signature.args[1]))]
        function = ir.FunctionType(ir.VoidType(), [value.type for value in each])
        builder.call(builder.inttoptr(target, function.as_pointer()), each)
        return context.get_dummy_value()

    return types.void(run, addresses), build


@register_jitable  # type: ignore[untyped-decorator]
def _load(block, sources, first, here, step, blank, state):  # type: ignore[no-untyped-def]
    """Load the incoming rows; lanes from ``here`` on have no track and get the rows of lane 0."""
    for lane in range(WIDTH):
        e = first + lane if lane < here else first
        t = state.epoch[e] + step
        loaded = t < state.length[e]
        sources[lane] = address(state.table, e, t) if loaded else blank.ctypes.data
    gather(block, sources, len(blank))


@register_jitable  # type: ignore[untyped-decorator]
def _make(block, b, here, step, blank, state):  # type: ignore[no-untyped-def]
    """Let the feed compute the incoming rows; past the end of a track, set them to ``blank``."""
    feed = state.feed
    call(feed.run, (block.ctypes.data, feed.settings.ctypes.data, feed.kept[b].ctypes.data))
    for lane in range(here):
        e = b * WIDTH + lane
        if state.epoch[e] + step >= state.length[e]:
            for i in range(len(blank)):
                block[i, lane] = blank[i]


@register_jitable  # type: ignore[untyped-decorator]
def _aim(targets, first, here, step, out, nowhere):  # type: ignore[no-untyped-def]
    """Set the address for each lane's results: ``nowhere`` if the lane has no track."""
    for lane in range(WIDTH):
        targets[lane] = address(out, first + lane, step) if lane < here else nowhere.ctypes.data


@register_jitable  # type: ignore[untyped-decorator]
def _take_in(b, step, blank, state, io, sources):  # type: ignore[no-untyped-def]
    """Bring a block into the caches and set its incoming rows and inputs."""
    block = state.rows[b]
    first = b * WIDTH
    here = min(WIDTH, len(state.length) - first)
    touched = 0.0
    if state.rows.size > NEAR:
        for i in range(len(block)):
            touched = max(touched, block[i, 0])
    if state.feed.run != 0:
        _make(block, b, here, step, blank, state)
    else:
        _load(block, sources, first, here, step, blank, state)
    for lane in range(here):
        for i in range(len(io.input_rows)):
            block[io.input_rows[i], lane] = io.inputs[first + lane, step, i]
    return touched


@register_jitable  # type: ignore[untyped-decorator]
def _give_out(b, step, state, io, targets, nowhere):  # type: ignore[no-untyped-def]
    """Write the outputs and observations of a block to their arrays."""
    first = b * WIDTH
    here = min(WIDTH, len(state.length) - first)
    _aim(targets, first, here, step, io.outputs, nowhere)
    scatter(state.rows[b], io.output_rows, targets)
    _aim(targets, first, here, step, io.observations, nowhere)
    scatter_single(state.rows[b], io.obs_rows, targets)


@register_jitable  # type: ignore[untyped-decorator]
def advance(begin, end, run, blank, state, io):  # type: ignore[no-untyped-def]
    """Run the tracks of blocks ``begin`` to ``end``.

    Callers ignore the returned number. It only keeps the compiler from dropping the reads that
    bring rows into the caches.

    A program reads its rows in an order that hardware prefetchers cannot guess. If the blocks do
    not all fit into the core's own caches, reading the rows once in order, before the program runs,
    saves a fifth of the run time or more. The core's first-level cache can't hold the code of both
    feed and program, so the feed runs for some blocks before the program runs for these blocks. The
    loops copy single numbers because numba takes long to compile slices of arrays.

    Args:
        begin, end: first block, and the block after the last.
        run: address of the program, as ``Program.on_lanes`` returns it.
        blank: (incoming,) placeholder to load when a track has ended.
        state, io: the tracks (:class:`~mmwave_env.compiler.program.BatchState`), and their inputs
            and outputs (:class:`~mmwave_env.compiler.program.StepIO`).
    """
    epochs = io.outputs.shape[1]
    addresses = np.empty(WIDTH, np.int64)
    nowhere = np.empty(max(len(io.output_rows), len(io.obs_rows)))
    touched = 0.0
    for first in range(begin, end, TOGETHER):
        after = min(first + TOGETHER, end)
        for step in range(epochs):
            for b in range(first, after):
                touched += _take_in(b, step, blank, state, io, addresses)
            for b in range(first, after):
                call(run, (state.rows[b].ctypes.data,))
                _give_out(b, step, state, io, addresses, nowhere)
    for e in range(begin * WIDTH, min(end * WIDTH, len(state.epoch))):
        state.epoch[e] += epochs
    return touched
