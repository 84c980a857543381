"""The loop that runs a compiled program for many tracks, epoch by epoch, eight tracks at a time.

The numbers of eight tracks form a *block*: an array in which each track has one column, its *lane*.
In each epoch, a block's *incoming* rows (the epoch's data) are loaded from a table, or a *feed* (a
compiled function) computes them. Results are written to arrays.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, register_jitable

from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.compiler.lanes import WIDTH

NEAR = 2**16  # if all blocks together have up to this many numbers, a core's own caches hold them
TOGETHER = 8  # a feed runs for this many blocks, and then the program runs for the same blocks


@intrinsic  # type: ignore[untyped-decorator]
def call(_, run, addresses):  # type: ignore[no-untyped-def]
    """Call the C function at the address ``run`` with the addresses of arrays.

    ``Program.on_lanes`` returns the address of a program, whose argument is a block (size, 8);
    ``program.Feed`` describes the arguments of a feed. Only compiled code can use this function.
    """

    def build(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        target, packed = arguments
        each = [builder.extract_value(packed, i) for i in range(len(signature.args[1]))]
        function = ir.FunctionType(ir.VoidType(), [value.type for value in each])
        builder.call(builder.inttoptr(target, function.as_pointer()), each)
        return context.get_dummy_value()

    return types.void(run, addresses), build


@register_jitable  # type: ignore[untyped-decorator]
def _take_in(b, step, blank, state, io):  # type: ignore[no-untyped-def]
    """Bring a block into the caches and set its incoming rows and inputs."""
    block = state.rows[b]
    feed = state.feed
    touched = 0.0
    if state.rows.size > NEAR:
        for i in range(len(block)):
            touched = max(touched, block[i, 0])
    if feed.run != 0:
        call(feed.run, (block.ctypes.data, feed.settings.ctypes.data, feed.kept[b].ctypes.data))
    for lane in range(min(WIDTH, len(state.length) - b * WIDTH)):
        e = b * WIDTH + lane
        t = state.epoch[e] + step
        if t >= state.length[e]:
            for i in range(len(blank)):
                block[i, lane] = blank[i]
        elif feed.run == 0:
            for i in range(len(blank)):
                block[i, lane] = state.table[e, t, i]
        for i in range(len(io.input_rows)):
            block[io.input_rows[i], lane] = io.inputs[e, step, i]
    return touched


@register_jitable  # type: ignore[untyped-decorator]
def _give_out(b, step, state, io):  # type: ignore[no-untyped-def]
    """Write the outputs and observations of a block to their arrays."""
    block = state.rows[b]
    first = b * WIDTH
    here = min(WIDTH, len(state.length) - first)
    for i in range(len(io.output_rows)):
        for lane in range(here):
            io.outputs[first + lane, step, i] = block[io.output_rows[i], lane]
    for i in range(len(io.obs_rows)):
        for lane in range(here):
            io.observations[first + lane, step, i] = block[io.obs_rows[i], lane]


@compiled
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
    touched = 0.0
    for first in range(begin, end, TOGETHER):
        after = min(first + TOGETHER, end)
        for step in range(epochs):
            for b in range(first, after):
                touched += _take_in(b, step, blank, state, io)
            for b in range(first, after):
                call(run, (state.rows[b].ctypes.data,))
                _give_out(b, step, state, io)
    for e in range(begin * WIDTH, min(end * WIDTH, len(state.epoch))):
        state.epoch[e] += epochs
    return touched
