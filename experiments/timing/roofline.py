"""Roofline model: the least time that a core needs for a kernel (a compiled function).

The model assumes that all arithmetic shares the core's vector units. So the operations are timed
together, in the kernel's proportions. They form several independent *chains*: each operation needs
the previous result of its chain. Loads and stores use other units beside the arithmetic, and take
less time in every kernel. They are ignored, as are waits for results, register spills, caches and
code fetches.

Operations are counted exactly, by running the kernel's function. Lanes (SIMD values) emit
instructions through an LLVM builder. The builder here only records them; nothing is compiled.
"""

import timeit
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir

from mmwave_env.compiler.lanes import WIDTH, Emitter, kernel
from mmwave_env.numerics.numbers import sqrt, where
from mmwave_env.numerics.pytree import flatten, unflatten
from mmwave_env.numerics.tape import Tracer

_KINDS = {"fadd": "add", "fsub": "add", "fmul": "multiply", "fdiv": "divide"}
_KINDS |= {"llvm.sqrt": "root", "load": "load", "bitcast": "free"}  # all others: "select"
_COMMUTE = ("fadd", "fmul", "and_", "or_")  # instructions whose operands may be exchanged


class Operations(NamedTuple):
    """Numbers of SIMD instructions, each of which works on eight environments."""

    fused: int = 0  # multiply-adds: sums in which one term is a product used nowhere else
    add: int = 0  # remaining sums and differences
    multiply: int = 0  # remaining products
    divide: int = 0
    root: int = 0  # square roots
    select: int = 0  # comparisons, choices, and operations on signs and bits


@dataclass(frozen=True, eq=False)
class _Instruction:
    kind: str
    operands: tuple[Any, ...]  # instructions, and constants as text

    def sources(self) -> list["_Instruction"]:
        return [operand for operand in self.operands if isinstance(operand, _Instruction)]


class _Recorder:
    """A replacement for an LLVM builder; it records repeated instructions only once."""

    def __init__(self) -> None:
        self.module = ir.Module()
        self.known: dict[tuple[Any, ...], _Instruction] = {}

    def call(self, function: Any, operands: Sequence[Any], **_: Any) -> _Instruction:
        """Record a vector intrinsic, llvm.<name>.v8f64."""
        return self._record(function.name.rpartition(".")[0], operands)

    def select(self, condition: _Instruction, a: Any, b: Any) -> _Instruction:
        """Record a choice; a choice between the compared values is a minimum or maximum."""
        operator, *compared = condition.operands
        chosen = [_operand(a), _operand(b)]
        if chosen in (compared, compared[::-1]):
            return self._record("extremum", [operator, *compared, chosen == compared])
        return self._record("select", [condition, a, b])

    def __getattr__(self, name: str) -> Callable[..., _Instruction]:
        return lambda *operands, **_: self._record(name, operands)

    def _record(self, name: str, operands: Sequence[Any]) -> _Instruction:
        values = [_operand(value) for value in operands]
        if name in _COMMUTE:
            values.sort(key=lambda value: value if isinstance(value, str) else str(id(value)))
        made = _Instruction(_KINDS.get(name, "select"), tuple(values))
        return self.known.setdefault((name, *values), made)


def _operand(value: Any) -> Any:
    return value if isinstance(value, _Instruction) else str(value)


def count(function: Callable[[Any], Any], template: Any) -> Operations:
    """Count the operations of a function that maps a tree of numbers to a tree of the same shape.

    Unused results and unchanged numbers cost nothing, as in a
    :class:`~mmwave_env.compiler.program.Program`.
    """
    recorder = _Recorder()
    emitter = Emitter(recorder)
    before = [Tracer(emitter, recorder.load(row)) for row in range(len(flatten(template)))]
    after = flatten(function(unflatten(template, iter(before))))
    results = [
        new.value
        for old, new in zip(before, after, strict=True)
        if isinstance(new, Tracer) and new is not old
    ]
    needed = set(results)  # every instruction on which the results depend
    for step in reversed(recorder.known.values()):
        if step in needed:
            needed.update(step.sources())
    kinds = Counter(step.kind for step in needed)
    uses = Counter(source for step in needed for source in step.sources()) + Counter(results)
    fused = sum(
        any(source.kind == "multiply" and uses[source] == 1 for source in step.sources())
        for step in needed
        if step.kind == "add"
    )
    # Divisions by the same divisor become products with its reciprocal (LLVM's flag "arcp").
    divisors = Counter(step.operands[1] for step in needed if step.kind == "divide")
    products = sum(quotients for quotients in divisors.values() if quotients > 1)
    kinds.update(fused=fused, multiply=products - fused, add=-fused)
    kinds["divide"] = len(divisors)
    return Operations(**{kind: kinds[kind] for kind in Operations._fields})


CHAINS = (8, 16, 24)  # numbers of chains to try: the best number depends on the processor
LENGTH = 480  # operations per pass of a timed loop; their code fits into any cache
ROWS = 64  # rows of the block that a timed loop works on
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
    steps: dict[str, float] = operations._asdict()
    steps["select"] /= 2  # a timed "select" step does two operations: it compares, then chooses
    total = sum(steps.values())
    order: list[str] = []  # kinds of operations, evenly mixed, in the proportions of the kernel
    for length in range(1, LENGTH + 1):
        lag = {kind: length * steps[kind] / total - order.count(kind) for kind in _STEPS}
        order.append(max(_STEPS, key=lag.__getitem__))
    block = np.full((ROWS, WIDTH), 1.7)
    block[:2] = [[1.0], [0.0]]
    times = []
    for chains in CHAINS:
        repeat = _chains(tuple(order), chains)
        repeat(block, 1)  # the first call compiles
        times += timeit.repeat(partial(repeat, block, CALLS), number=1, repeat=TRIES)
    return total * min(times) / (CALLS * LENGTH)


@cache
def _chains(order: tuple[str, ...], chains: int) -> Any:
    """Compile steps on independent chains; steps of the same kind use the chains in turn."""

    def steps(rows: list[Any]) -> list[Any]:
        others = rows[:3]  # factor, term, other
        x = rows[3 : 3 + chains]
        taken = Counter[str]()
        for kind in order:
            chain = taken[kind] % chains
            x[chain] = _STEPS[kind](x[chain], *others)
            taken[kind] += 1
        return [*others, *x, *rows[3 + chains :]]

    run = kernel(steps, [0.0] * ROWS)

    @numba.njit  # type: ignore[untyped-decorator]
    def repeat(block, calls):  # type: ignore[no-untyped-def]
        for _ in range(calls):
            run((block.ctypes.data,))

    return repeat
