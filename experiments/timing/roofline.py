"""Roofline model: the least time that a core needs for a kernel (a compiled function).

The model assumes that all arithmetic shares the core's vector units. So the operations are timed
together, in the kernel's proportions. They form several independent *chains*: each operation needs
the previous result of its chain. Loads and stores use other units and are timed separately; the
limit is the longer time. Waits for results, register spills, caches and code fetches are ignored.
"""

import timeit
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np

from experiments.timing.operations import Operations
from mmwave_env.compiler.lanes import WIDTH, kernel
from mmwave_env.numerics.numbers import sqrt, where

CHAINS = (8, 16, 24)  # numbers of chains to try: the best number depends on the processor
LENGTH = 480  # operations per pass of a timed loop; their code fits into any cache
# size of the copied data: 16 KiB, which fits into any first-level cache
BLOCKS = 4
ROWS = 64
CALLS = 1000
TRIES = 10

# Steps of a chain; the factor is 1 and the term 0, but the compiler does not know this.
_STEPS: dict[str, Callable[..., Any]] = {
    "fused": lambda x, factor, term, other: x * factor + term,
    "add": lambda x, factor, term, other: x + term,
    "multiply": lambda x, factor, term, other: x * factor,
    "divide": lambda x, factor, term, other: other / x,
    "root": lambda x, factor, term, other: sqrt(x),
    "select": lambda x, factor, term, other: where(x > term, x, other),
}


def limit_s(operations: Operations) -> float:
    """Return the minimum time, s, that a core needs for operations on eight environments."""
    steps = sum(_steps(operations).values())
    rows = max(operations.load, operations.store)
    order = interleaved(operations)
    blocks = np.full((1, ROWS, WIDTH), 1.7)
    blocks[:, :2] = [[1.0], [0.0]]
    # mix_s: seconds per operation of the mix, at the best number of chains. copying_s: seconds per
    # pair of a load and a store.
    mix_s = min(_seconds(_chains(order, chains), blocks) for chains in CHAINS) / LENGTH
    copying_s = _seconds(_copying(), np.zeros((BLOCKS, ROWS, WIDTH))) / (BLOCKS * ROWS // 2)
    return max(steps * mix_s, rows * copying_s)


def interleaved(operations: Operations) -> tuple[str, ...]:
    """Return the kinds of ``LENGTH`` operations, evenly mixed, in the proportions of a kernel."""
    steps = _steps(operations)
    total = sum(steps.values())
    order: list[str] = []
    for length in range(1, LENGTH + 1):
        lag = {kind: length * steps[kind] / total - order.count(kind) for kind in _STEPS}
        order.append(max(_STEPS, key=lag.__getitem__))
    return tuple(order)


def _steps(operations: Operations) -> dict[str, float]:
    steps = {kind: getattr(operations, kind) for kind in _STEPS}
    # A timed "select" step does two operations: it compares, then chooses.
    return steps | {"select": operations.select / 2}


@cache
def _chains(order: tuple[str, ...], chains: int) -> Any:
    """Compile steps on independent chains; steps of the same kind use the chains in turn."""

    def build(rows: Any) -> None:
        others = [rows[row] for row in range(3)]  # factor, term, other
        x = [rows[row] for row in range(3, 3 + chains)]
        taken = Counter[str]()
        for kind in order:
            chain = taken[kind] % chains
            x[chain] = _STEPS[kind](x[chain], *others)
            taken[kind] += 1
        for row, value in enumerate(x, start=3):
            rows[row] = value

    return _repeated(build)


@cache
def _copying() -> Any:
    def build(rows: Any) -> None:
        for row in range(0, ROWS, 2):
            rows[row] = rows[row + 1]

    return _repeated(build)


def _repeated(build: Callable[[Any], None]) -> Any:
    run = kernel(build, [ROWS])

    @numba.njit  # type: ignore[untyped-decorator]
    def repeat(blocks, calls):  # type: ignore[no-untyped-def]
        for _ in range(calls):
            for block in blocks:
                run((block.ctypes.data,))

    return repeat


def _seconds(repeat: Any, blocks: Any) -> float:
    """Return the seconds of a pass over the blocks, the minimum of several tries."""
    repeat(blocks, 1)  # the first call compiles
    return min(timeit.repeat(lambda: repeat(blocks, CALLS), number=1, repeat=TRIES)) / CALLS
