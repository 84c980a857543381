"""Drawing episodes: all randomness of each from its own generator, then the run on lanes."""

import numpy as np
from numba.extending import register_jitable

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.lazy_jit import LazyJit
from mmwave_env.compiler.program import advance
from mmwave_env.compiler.rng import RngView, load_state, save_state
from mmwave_env.episodes.travel import draw_kind, travel

PLAIN_DRAWN_EPOCHS = 20_000  # before compiling, which takes as long as 75 000 of them


NORMAL, UNIFORM, EXPONENTIAL = range(3)


@register_jitable
def _fill(kind, rng, out, first, last):  # type: ignore[no-untyped-def]
    for epoch in range(len(out)):
        for i in range(first, last):
            if kind == NORMAL:
                out[epoch, i] = rng.standard_normal()
            elif kind == UNIFORM:
                out[epoch, i] = rng.random()
            else:
                out[epoch, i] = rng.standard_exponential()
    return last


@register_jitable
def _draw(rng, out, links, rows):  # type: ignore[no-untyped-def]
    """Fill (T, draws) after the truth, in the order of the leaves of ``simulation.Draws``.

    The order of drawing, kind by kind over all epochs, is part of what a seed means.
    """
    at = _fill(NORMAL, rng, out, 6, 6 + links)  # shadowing
    at = _fill(UNIFORM, rng, out, at, at + links)  # blockage
    at = _fill(UNIFORM, rng, out, at, at + links)  # multipath
    at = _fill(UNIFORM, rng, out, at, at + 1)  # outage
    at = _fill(EXPONENTIAL, rng, out, at, at + links)  # range of blockage
    at = _fill(EXPONENTIAL, rng, out, at, at + links)  # of multipath
    at = _fill(NORMAL, rng, out, at, at + 3 * links)  # angles of blockage
    at = _fill(NORMAL, rng, out, at, at + 3 * links)  # of multipath
    at = _fill(UNIFORM, rng, out, at, at + links)  # detection
    at = _fill(NORMAL, rng, out, at, at + 1)  # scatter of the Doppler spread
    at = _fill(NORMAL, rng, out, at, at + 1)  # its floor
    at = _fill(NORMAL, rng, out, at, at + rows)  # noise
    _fill(NORMAL, rng, out, at, at + 1)  # oscillator


@register_jitable
def _simulate(  # type: ignore[no-untyped-def]
    rng, memory, states, plan, nets, dt, stride, move_on, observe, run, start, layout, keep, time_s,
    kinds, first, prior, tables,
):  # fmt: skip
    """Draw and simulate episodes, eight at a time, so that their draws stay in a cache.

    Args:
        rng, memory, states: of the dice, which numba takes long to recognize as a tuple.
        plan, nets, dt, stride, move_on, observe: see :func:`~mmwave_env.episodes.travel.travel`.
        run, start: the program, and its workspace before the first epoch, (1, size) for all
            episodes or (n, size).
        layout: numbers of links, of rows and of columns drawn, and the column of dt in a table.
        keep: rows of the workspace that make an epoch of ``tables``.
        time_s: (T,) of the epochs.
        kinds: (n,) gets those of :func:`~mmwave_env.episodes.travel.draw_kind`.
        first: (n, 7) gets the true position and velocity and the draw of the oscillator.
        prior: (n, 7) gets normals.
        tables: (n, T, columns) gets the episodes.
    """
    (links, rows, columns, dt_column), view, T = layout, RngView(rng, memory, states), len(time_s)
    draws, block = np.empty((WIDTH, T, columns)), np.empty((1, start.shape[1], WIDTH))
    blank, nothing, none = np.zeros(columns), np.empty((WIDTH, T, 0)), np.empty(0, np.int64)
    length, running = np.full(WIDTH, T), np.ones(WIDTH, np.bool_)
    for begin in range(0, len(kinds), WIDTH):
        end = min(begin + WIDTH, len(kinds))
        here = end - begin
        for e in range(begin, end):
            load_state(view, e)
            kinds[e] = draw_kind(rng, plan, T)
            save_state(view, e)
        travel(view, begin, kinds[begin:end], plan, nets, dt, stride, move_on, observe, draws)
        for e in range(begin, end):
            drawn = draws[e - begin]
            load_state(view, e)
            _draw(rng, drawn, links, rows)
            for i in range(prior.shape[1]):
                prior[e, i] = rng.standard_normal()
            save_state(view, e)
            for i in range(6):
                first[e, i] = drawn[0, i]
            first[e, 6] = drawn[0, columns - 1]
        for lane in range(WIDTH):
            own = start[(begin + lane) % len(start)]
            for i in range(len(own)):
                block[0, i, lane] = own[i]
        advance(
            0, 1, run, blank, block, draws[:here], length[:here], np.zeros(here, np.int64),
            running[:here], none, nothing[:here], keep, tables[begin:end], none,
            np.empty((here, T, 0), np.float32),
        )  # fmt: skip
        for e in range(begin, end):
            for t in range(1, T):
                tables[e, t, dt_column] = time_s[t] - time_s[t - 1]


simulate = LazyJit(_simulate, PLAIN_DRAWN_EPOCHS)
