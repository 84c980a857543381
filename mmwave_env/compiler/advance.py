"""The loop around programs: it runs many tracks epoch after epoch, eight tracks at a time.

Incoming rows are loaded from a table or made by a feed; results are written to arrays. The loop
runs as compiled code and as plain Python.
"""

import ctypes

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload, register_jitable

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.transpose import LINE, address, gather, prefetch, scatter, scatter_single
from mmwave_env.numerics.numbers import Array

NEAR = 2**16  # numbers of workspaces that fit into the core's own caches
TOGETHER = 8  # blocks that a feed runs for before the program does


def call(run: int, block: Array) -> None:
    """Run a program on a block (size, 8), by the address that ``Program.on_lanes`` returns."""
    ctypes.CFUNCTYPE(None, ctypes.c_int64)(run)(block.ctypes.data)


def call_feed(run: int, block: Array, kept: Array, settings: Array) -> None:
    """Run a feed's function, by its address, on blocks as :class:`Feed` has them."""
    takes = [ctypes.c_int64] * 3
    ctypes.CFUNCTYPE(None, *takes)(run)(*(part.ctypes.data for part in (block, settings, kept)))


@overload(call)  # type: ignore[untyped-decorator]
def _compiled_call(run, block):  # type: ignore[no-untyped-def]
    return lambda run, block: _jump(run, (block.ctypes.data,))


@overload(call_feed)  # type: ignore[untyped-decorator]
def _compiled_call_feed(run, block, kept, settings):  # type: ignore[no-untyped-def]
    def compiled(run, block, kept, settings):  # type: ignore[no-untyped-def]
        _jump(run, (block.ctypes.data, settings.ctypes.data, kept.ctypes.data))

    return compiled


@intrinsic  # type: ignore[untyped-decorator]
def _jump(_, run, places):  # type: ignore[no-untyped-def]
    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        address, packed = arguments
        each = [builder.extract_value(packed, i) for i in range(len(signature.args[1]))]
        function = ir.FunctionType(ir.VoidType(), [place.type for place in each])
        builder.call(builder.inttoptr(address, function.as_pointer()), each)
        return context.get_dummy_value()

    return types.void(run, places), build


@register_jitable  # type: ignore[untyped-decorator]
def _load(block, sources, first, here, step, blank, table, length, epoch):  # type: ignore[no-untyped-def]
    """Load the incoming rows; lanes past the last track repeat the first track of their block."""
    for lane in range(WIDTH):
        e = first + lane if lane < here else first
        t = epoch[e] + step
        sources[lane] = address(table, e, t) if t < length[e] else blank.ctypes.data
    gather(block, sources, len(blank))


@register_jitable  # type: ignore[untyped-decorator]
def _make(block, feed, b, here, step, blank, length, epoch):  # type: ignore[no-untyped-def]
    """Let the feed make the incoming rows."""
    run, settings, kept, timed, times = feed
    call_feed(run, block, kept[b], settings)
    for lane in range(here):
        e = b * WIDTH + lane
        t = epoch[e] + step
        if t < length[e]:
            block[timed, lane] = times[t]
            continue
        for i in range(len(blank)):
            block[i, lane] = blank[i]


@register_jitable  # type: ignore[untyped-decorator]
def _aim(targets, first, here, step, running, out, nowhere):  # type: ignore[no-untyped-def]
    """Set the address that each lane writes to; lanes without a running track write to waste."""
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
def _copy(source, target):  # type: ignore[no-untyped-def]
    """Copy the rows of a block."""
    for i in range(len(source)):
        for lane in range(WIDTH):
            target[i, lane] = source[i, lane]


@register_jitable  # type: ignore[untyped-decorator]
def _put_back(before, block, b, n, running):  # type: ignore[no-untyped-def]
    """Restore the lanes of tracks that do not run."""
    for lane in range(min(WIDTH, n - b * WIDTH)):
        if not running[b * WIDTH + lane]:
            for i in range(len(block)):
                block[i, lane] = before[i, lane]


@register_jitable  # type: ignore[untyped-decorator]
def _idle(b, n, running):  # type: ignore[no-untyped-def]
    """Count the tracks of a block that do not run."""
    idle = 0
    for e in range(b * WIDTH, min(b * WIDTH + WIDTH, n)):
        idle += not running[e]
    return idle


@register_jitable  # type: ignore[untyped-decorator]
def _take_in(  # type: ignore[no-untyped-def]
    b, end, step, blank, rows, feed, table, length, epoch, input_rows, inputs, at
):
    """Bring a block into the caches and set its incoming rows and inputs."""
    n, block, first = len(length), rows[b], b * WIDTH
    here = min(WIDTH, n - first)
    touched = 0.0
    if rows.size > NEAR:
        for i in range(len(block)):
            touched = max(touched, block[i, 0])
    if feed[0] != 0:
        _make(block, feed, b, here, step, blank, length, epoch)
    else:
        _announce(first + here, min(first + here + WIDTH, end * WIDTH, n), table, length, epoch)
        _load(block, at, first, here, step, blank, table, length, epoch)
    for lane in range(here):
        for i in range(len(input_rows)):
            block[input_rows[i], lane] = inputs[first + lane, step, i]
    return touched


@register_jitable  # type: ignore[untyped-decorator]
def _give_out(  # type: ignore[no-untyped-def]
    b, step, rows, running, output_rows, outputs, obs_rows, observations, at, nowhere
):
    """Write the outputs and observations of a block to their arrays."""
    first = b * WIDTH
    here = min(WIDTH, len(running) - first)
    _aim(at, first, here, step, running, outputs, nowhere)
    scatter(rows[b], output_rows, at)
    _aim(at, first, here, step, running, observations, nowhere)
    scatter_single(rows[b], obs_rows, at)


@register_jitable  # type: ignore[untyped-decorator]
def _finish(b, n, rows, before, feed, kept_before, running, epoch, epochs):  # type: ignore[no-untyped-def]
    """Count the epochs that a block ran, and restore the tracks that were not to run."""
    for e in range(b * WIDTH, min(b * WIDTH + WIDTH, n)):
        if running[e]:
            epoch[e] += epochs
    if _idle(b, n, running) > 0:
        _put_back(before, rows[b], b, n, running)
        if feed[0] != 0:
            _put_back(kept_before, feed[2][b], b, n, running)


@register_jitable  # type: ignore[untyped-decorator]
def _some_blocks(b, end, rows, feed, running, before, kept_before, some):  # type: ignore[no-untyped-def]
    """Find the next blocks with a running track; save those in which another track is idle.

    Returns:
        The number of blocks found, and the block to continue with.
    """
    n, count = len(running), 0
    while b < end and count < len(some):
        idle = _idle(b, n, running)
        if idle < min(WIDTH, n - b * WIDTH):
            some[count] = b
            if idle > 0:
                _copy(rows[b], before[count])
                if feed[0] != 0:
                    _copy(feed[2][b], kept_before[count])
            count += 1
        b += 1
    return count, b


@register_jitable  # type: ignore[untyped-decorator]
def advance(  # type: ignore[no-untyped-def]
    begin, end, run, blank, rows, feed, table, length, epoch, running, input_rows, inputs,
    output_rows, outputs, obs_rows, observations,
):  # fmt: skip
    """Run the tracks of blocks ``begin`` to ``end``.

    Ignore the returned number: without it the compiler would drop the reads that bring rows into
    the caches.

    A program reads its rows in an order that no prefetcher guesses. If the blocks of all
    environments do not fit into the near caches, reading the rows once in order halves the time of
    a program. The epochs that the next block will load are as far apart as episodes are long, so
    they are prefetched. The code of a feed and the code of a program do not fit into the core's
    first cache together, so each runs for some blocks in a row.
    All loops are plain because slices of arrays take numba long to compile.
    """
    n, epochs, some = len(length), outputs.shape[1], np.empty(min(TOGETHER, end - begin), np.int64)
    before = np.empty((len(some), rows.shape[1], WIDTH))
    kept_before = np.empty((len(some), feed[2].shape[1], WIDTH))
    at, nowhere = np.empty(WIDTH, np.int64), np.empty(max(len(output_rows), len(obs_rows)))
    touched, b = 0.0, begin
    while b < end:
        count, b = _some_blocks(b, end, rows, feed, running, before, kept_before, some)
        for step in range(epochs):
            for i in range(count):
                touched += _take_in(
                    some[i], end, step, blank, rows, feed, table, length, epoch, input_rows,
                    inputs, at,
                )  # fmt: skip
            for i in range(count):
                call(run, rows[some[i]])
                _give_out(
                    some[i], step, rows, running, output_rows, outputs, obs_rows, observations,
                    at, nowhere,
                )  # fmt: skip
        for i in range(count):
            _finish(some[i], n, rows, before[i], feed, kept_before[i], running, epoch, epochs)
    return touched
