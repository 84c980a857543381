"""Numbers that record every operation on them in a list, the *tape* of a function.

These numbers hide their value, as lanes (SIMD numbers for eight environments) do. So a function
that runs on them can also be compiled for lanes.

A function's compiled code is stored under a hash of the tape, the *fingerprint*. Two functions have
the same fingerprint only if they apply the same operations to the same inputs and constants; then
each can run the compiled code of the other. A function that was changed gets a new fingerprint, so
old code is never run for it. Writing a tape takes a hundredth of the time of compiling.
"""

from collections.abc import Callable, Sequence
from hashlib import sha256
from typing import Any

from mmwave_env.numerics.pytree import Tree, flatten, unflatten
from mmwave_env.numerics.tracer import Tracer, TracerCondition

Tape = list[tuple[Any, ...]]


def taped(template: Tree, tape: Tape) -> Tree:
    """Return a tree of the template's shape whose leaves record operations on the tape."""
    rows = range(len(flatten(template)))
    return unflatten(template, (_Number(tape, -1 - row) for row in rows))


def fingerprint(function: Callable[[Tree], Tree], template: Tree) -> str:
    """Return the fingerprint, 20 hexadecimal digits, of a function of trees like the template."""
    tape: Tape = []
    results = _references(flatten(function(taped(template, tape))))
    whole = len(flatten(template)), tape, results
    return sha256(repr(whole).encode()).hexdigest()[:20]


class _Recorded:
    """The result of operation ``number`` on the tape; a negative ``number`` stands for an input."""

    __slots__ = ("number", "tape")

    def __init__(self, tape: Tape, number: int) -> None:
        self.tape = tape
        self.number = number

    def _record(self, op: str, *operands: Any) -> tuple[Tape, int]:
        self.tape.append((op, *_references(operands)))
        return self.tape, len(self.tape) - 1


def _references(operands: Sequence[Any]) -> list[int | float]:
    """Return operands as they are recorded: earlier results by number (int), constants as float."""
    return [a.number if isinstance(a, _Recorded) else float(a) for a in operands]


def _joining(op: str) -> Any:
    """Return an operation whose result has the type of the operands."""
    return lambda a, b: type(a)(*a._record(op, a, b))


class _Condition(_Recorded, TracerCondition):
    __slots__ = ()
    __and__ = _joining("&")
    __or__ = _joining("|")

    def select(self, a: Any, b: Any) -> "_Number":
        return _Number(*self._record("select", self, a, b))


def _recording(op: str) -> Any:
    return lambda *operands: _Number(*operands[0]._record(op, *operands))


class _Number(_Recorded, Tracer):
    __slots__ = ()

    def combine(self, op: str, a: Any, b: Any) -> "_Number":
        return _Number(*self._record(op, a, b))

    def compare(self, op: str, other: Any) -> _Condition:
        return _Condition(*self._record(op, self, other))

    __neg__ = _recording("neg")
    __abs__ = _recording("abs")
    sqrt = _recording("sqrt")
    log = _recording("log")
    exp = _recording("exp")
    atan2 = _recording("atan2")
    floor = _recording("floor")

    def as_word(self) -> "_Word":
        return _Word(*self._record("as word", self))

    def constant(self, value: float) -> "_Number":
        return _Number(*self._record("constant", value))

    def cos_sin(self) -> "tuple[_Number, _Number]":
        return _Number(*self._record("cos", self)), _Number(*self._record("sin", self))


class _Word(_Recorded):
    __slots__ = ()
    __add__ = _joining("+")
    __xor__ = _joining("^")
    __or__ = _joining("|")
    __lshift__ = _joining("<<")
    __rshift__ = _joining(">>")

    def scaled(self, factor: float) -> _Number:
        return _Number(*self._record("scaled", self, factor))

    def as_number(self) -> _Number:
        return _Number(*self._record("as number", self))
