"""Exact counts of the operations of a function of numbers, obtained by running the function.

:class:`~mmwave_env.compiler.lanes.Lanes` (SIMD values) emit instructions through an LLVM builder.
The builder here only records instructions, which are counted without compiling the function.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from llvmlite import ir

from mmwave_env.compiler.lanes import Lanes
from mmwave_env.numerics.pytree import flatten, unflatten

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
    load: int = 0  # loads of rows of the workspace
    store: int = 0  # stores of rows


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
        self._known: dict[tuple[Any, ...], _Instruction] = {}

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
        return self._known.setdefault((name, *values), made)


def _operand(value: Any) -> Any:
    return value if isinstance(value, _Instruction) else str(value)


def count(function: Callable[[Any], Any], template: Any) -> Operations:
    """Count the operations of a function that maps a tree of numbers to a tree of the same shape.

    Unused results and unchanged numbers cost nothing, as in a
    :class:`~mmwave_env.compiler.program.Program`.
    """
    recorder = _Recorder()
    before = [Lanes(recorder, recorder.load(row)) for row in range(len(flatten(template)))]
    after = flatten(function(unflatten(template, iter(before))))
    stored = [new for old, new in zip(before, after, strict=True) if new is not old]
    results = [new.value for new in stored if isinstance(new, Lanes)]
    needed = list(_needed(results))
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
    kinds.update(fused=fused, store=len(stored), multiply=products - fused, add=-fused)
    kinds["divide"] = len(divisors)
    return Operations(**{kind: kinds[kind] for kind in Operations._fields})


def _needed(results: Iterable[_Instruction]) -> Iterator[_Instruction]:
    """Yield every instruction on which the results depend, once."""
    waiting = list(results)
    yielded = set()
    while waiting:
        step = waiting.pop()
        if step not in yielded:
            yielded.add(step)
            waiting += step.sources()
            yield step
