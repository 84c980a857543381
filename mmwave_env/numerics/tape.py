"""Numbers that hide their value: a *recorder* gets every operation on them.

A function that runs on such numbers never asks for a value, so it can be compiled for lanes (SIMD
numbers for eight environments). An operation that needs a value is refused:
branches and comparisons by == by :class:`Traced`, all others by Python itself, as they are not
defined here. There are two recorders: a :class:`Tape` lists the operations, and that of
:mod:`mmwave_env.compiler.lanes` emits their instructions.

A function's compiled code is stored under a hash of the tape, the *fingerprint*. Two functions have
the same fingerprint only if they apply the same operations to the same inputs and constants; then
each can run the compiled code of the other. A function that was changed gets a new fingerprint, so
old code is never run for it. Writing a tape takes a hundredth of the time of compiling.
"""

from collections.abc import Callable, Sequence
from hashlib import sha256
from typing import Any

from mmwave_env.numerics.pytree import Tree, flatten, unflatten


def _refusal(operation: str, instead: str) -> TypeError:
    return TypeError(
        f"{operation} needs the value of a number that stands for 8 environments: write {instead}"
    )


class Traced:
    """A hidden number, condition or word; its ``value`` is what the recorder returned for it.

    Operations have the names that LLVM's builder gives them, if there is one instruction for them.
    """

    __slots__ = ("recorder", "value")
    __array_ufunc__ = None  # numpy then refuses its own functions, and leaves operators to Python

    def __init__(self, recorder: Any, value: Any) -> None:
        self.recorder = recorder
        self.value = value

    def __bool__(self) -> bool:
        raise _refusal(
            "a branch",
            "where(condition, a, b) for 'if' and 'while', & and | for 'and' and 'or', and "
            "maximum(a, b) and minimum(a, b) for max and min; these functions are in "
            "mmwave_env.numerics.numbers",
        )

    def __eq__(self, other: object) -> bool:
        raise _refusal("a comparison by == or !=", "where(abs(a - b) < tolerance, ...)")

    __ne__ = __eq__
    __hash__ = None  # type: ignore[assignment]


def _joining(op: str) -> Any:
    """Return an operation whose result has the type of the operands."""
    return lambda a, b: type(a)(a.recorder, a.recorder.emit(op, a, b))


def _recording(op: str) -> Any:
    """Return an operation whose result is a number."""
    return lambda *operands: Tracer(operands[0].recorder, operands[0].recorder.emit(op, *operands))


def _comparing(op: str) -> Any:
    return lambda a, b: _emitted(TracerCondition, op, a, b)


def _combining(op: str) -> tuple[Any, Any]:
    """Return an operator and its reflected form, which Python calls on the right operand."""
    return lambda a, b: _combined(op, a, b), lambda b, a: _combined(op, a, b)


class TracerCondition(Traced):
    """A condition on hidden numbers, for ``where``; ``&`` and ``|`` combine two conditions."""

    __slots__ = ()
    __and__ = _joining("and_")
    __or__ = _joining("or_")
    select = _recording("select")


class Tracer(Traced):
    """A number that hides its value; a comparison with NaN is false."""

    __slots__ = ()
    __add__, __radd__ = _combining("fadd")
    __sub__, __rsub__ = _combining("fsub")
    __mul__, __rmul__ = _combining("fmul")
    __truediv__, __rtruediv__ = _combining("fdiv")
    __lt__ = _comparing("<")
    __le__ = _comparing("<=")
    __gt__ = _comparing(">")
    __ge__ = _comparing(">=")
    __neg__ = _recording("fneg")
    __abs__ = _recording("fabs")
    sqrt = _recording("sqrt")
    floor = _recording("floor")
    log = _recording("log")
    exp = _recording("exp")
    cos = _recording("cos")
    sin = _recording("sin")
    atan2, atan2_of = _combining("atan2")

    def as_word(self) -> "TracerWord":
        """Return the bits of the number."""
        return TracerWord(self.recorder, self.recorder.emit("as word", self))


class TracerWord(Traced):
    """A hidden word of 64 bits (:class:`~mmwave_env.numerics.random.Word`)."""

    __slots__ = ()
    __add__ = _joining("add")
    __xor__ = _joining("xor")
    __or__ = _joining("or_")
    __lshift__ = _joining("shl")
    __rshift__ = _joining("lshr")
    # the integer, which must be below 2^63, times a factor; and the number that has these bits
    scaled = _recording("scaled")
    as_number = _recording("as number")


def _settled(op: str, a: Any, b: Any) -> Any:
    """Return the result if a constant 0 or 1 makes the instruction unnecessary; else None."""
    first = None if isinstance(a, Traced) else a
    second = None if isinstance(b, Traced) else b
    if op == "fmul":
        for constant, other in ((first, b), (second, a)):
            if constant in (0.0, 1.0):
                return other if constant else 0.0
    if op in ("fadd", "fsub") and second == 0.0:
        return a
    if op in ("fadd", "fdiv") and first == 0.0:
        return b if op == "fadd" else 0.0
    return None


def _combined(op: str, a: Any, b: Any) -> Any:
    settled = _settled(op, a, b)
    return _emitted(Tracer, op, a, b) if settled is None else settled


def _emitted(kind: type[Traced], op: str, a: Any, b: Any) -> Any:
    if isinstance(a, TracerCondition) or isinstance(b, TracerCondition):
        return NotImplemented  # so Python says that the types do not fit
    recorder = (a if isinstance(a, Tracer) else b).recorder
    return kind(recorder, recorder.emit(op, a, b))


Rows = list[tuple[Any, ...]]


class Tape:
    """A recorder that writes operations to rows.

    The value of a result is the index of its row; a negative value stands for an input.
    """

    def __init__(self, rows: Rows) -> None:
        self.rows = rows

    def emit(self, op: str, *operands: Any) -> int:
        """Record an operation; return the value of its result."""
        self.rows.append((op, *_references(operands)))
        return len(self.rows) - 1


def _references(operands: Sequence[Any]) -> list[int | float]:
    """Return operands as they are recorded: earlier results by index (int), constants as float."""
    return [a.value if isinstance(a, Traced) else float(a) for a in operands]


def taped(template: Tree, rows: Rows) -> Tree:
    """Return a tree of the template's shape whose leaves record operations in the rows."""
    tape = Tape(rows)
    return unflatten(template, (Tracer(tape, -1 - i) for i in range(len(flatten(template)))))


def fingerprint(function: Callable[[Tree], Tree], template: Tree) -> str:
    """Return the fingerprint, 20 hexadecimal digits, of a function of trees like the template."""
    rows: Rows = []
    results = _references(flatten(function(taped(template, rows))))
    whole = len(flatten(template)), rows, results
    return sha256(repr(whole).encode()).hexdigest()[:20]
