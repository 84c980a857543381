"""Numbers that record every operation on them in a list, the *tape* of a function.

These numbers hide their value, as lanes (SIMD numbers for eight environments) do. So a function
that runs on them can also be compiled for lanes: it never asks for a value. An operation that needs
a value is refused, and the message says what to write instead.

A function's compiled code is stored under a hash of the tape, the *fingerprint*. Two functions have
the same fingerprint only if they apply the same operations to the same inputs and constants; then
each can run the compiled code of the other. A function that was changed gets a new fingerprint, so
old code is never run for it. Writing a tape takes a hundredth of the time of compiling.
"""

from collections.abc import Callable, Sequence
from hashlib import sha256
from typing import Any, NoReturn

from mmwave_env.numerics.pytree import Tree, flatten, unflatten


class NoValueError(TypeError):
    """Error of a function that asks for a hidden value; the message says what to write instead."""


_NUMBERS = "mmwave_env.numerics.numbers"
_REFUSALS = {  # refused operation -> (the operation in words, what to write instead)
    "truth": (
        "a branch",
        "where(condition, a, b) for 'if' and 'while', & and | for 'and' and 'or', and "
        f"maximum(a, b) and minimum(a, b) for max and min; these functions are in {_NUMBERS}",
    ),
    "value": ("float(...) or math", f"the functions of {_NUMBERS} instead"),
    "integer": ("use as an integer", "a constant that is known before the function runs"),
    "numpy": ("numpy", f"lists and the functions of {_NUMBERS} and mmwave_env.numerics.linalg"),
    "equality": ("a comparison by == or !=", "where(abs(a - b) < tolerance, ...)"),
    "power": ("a power", "a * a for a ** 2, sqrt(a) for a ** 0.5, exp(p * log(a)) for a ** p"),
    "remainder": ("a remainder", "wrap(a) for angles, where(a > b, a - b, a) if a < 2 * b"),
    "floor": ("a division with //", "a / b"),
    "key": ("a key of a dict or set", "a list and a constant index, or where(condition, a, b)"),
    "mask as number": ("arithmetic with a condition", "where(condition, 1.0, 0.0)"),
    "inverse": ("negating a condition", "where(condition, b, a) for where(~condition, a, b)"),
    "number as mask": ("using a number as a condition", "where(a > 0.5, ...)"),
}


def _refuse(asked: str) -> NoReturn:
    operation, instead = _REFUSALS[asked]
    raise NoValueError(
        f"{operation} needs the value of a number that stands for 8 environments: write {instead}"
    )


def _refusing(asked: str) -> Any:
    return lambda *_, **__: _refuse(asked)


def _combining(op: str) -> tuple[Any, Any]:
    """Return an operator and its reflected form, which Python calls on the right operand."""
    return lambda a, b: _combined(op, a, b), lambda b, a: _combined(op, a, b)


def _comparing(op: str) -> Any:
    return lambda a, b: a.compare(op, b)


class TracerCondition:
    """A condition on hidden numbers, for ``where``; ``&`` and ``|`` combine two conditions."""

    __slots__ = ()
    __bool__ = _refusing("truth")
    __float__ = __add__ = __radd__ = __sub__ = __rsub__ = _refusing("mask as number")
    __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __neg__ = _refusing("mask as number")
    __lt__ = __le__ = __gt__ = __ge__ = _refusing("mask as number")
    __eq__ = __ne__ = _refusing("equality")
    __hash__ = _refusing("key")
    __invert__ = _refusing("inverse")


class Tracer:
    """A number that hides its value; subclasses implement ``combine`` and ``compare``."""

    __slots__ = ()
    __bool__ = _refusing("truth")
    __float__ = __complex__ = _refusing("value")
    __int__ = __index__ = __round__ = __trunc__ = __floor__ = __ceil__ = _refusing("integer")
    __array__ = __array_ufunc__ = _refusing("numpy")
    __eq__ = __ne__ = _refusing("equality")
    __pow__ = __rpow__ = _refusing("power")
    __mod__ = __rmod__ = __divmod__ = __rdivmod__ = _refusing("remainder")
    __floordiv__ = __rfloordiv__ = _refusing("floor")
    __hash__ = _refusing("key")
    select = _refusing("number as mask")

    def combine(self, op: str, a: Any, b: Any) -> Any:
        """Compute ``a op b`` for add, sub, mul or div, where ``a`` or ``b`` is this number."""
        raise NotImplementedError

    def compare(self, op: str, other: Any) -> Any:
        """Return the condition ``self op other`` for <, <=, > or >=."""
        raise NotImplementedError

    __add__, __radd__ = _combining("add")
    __sub__, __rsub__ = _combining("sub")
    __mul__, __rmul__ = _combining("mul")
    __truediv__, __rtruediv__ = _combining("div")
    __lt__ = _comparing("<")
    __le__ = _comparing("<=")
    __gt__ = _comparing(">")
    __ge__ = _comparing(">=")


def _settled(op: str, a: Any, b: Any) -> Any:
    """Return the result if a constant 0 or 1 makes the instruction unnecessary; else None."""
    if op == "mul":
        for u, v in ((a, b), (b, a)):
            if not isinstance(u, Tracer) and u in (0.0, 1.0):
                return v if u else 0.0
    if op in ("add", "sub") and not isinstance(b, Tracer) and b == 0.0:
        return a
    if op == "add" and not isinstance(a, Tracer) and a == 0.0:
        return b
    if op == "div" and not isinstance(a, Tracer) and a == 0.0:
        return 0.0
    return None


def _combined(op: str, a: Any, b: Any) -> Any:
    if isinstance(a, TracerCondition) or isinstance(b, TracerCondition):
        _refuse("mask as number")
    settled = _settled(op, a, b)
    if settled is not None:
        return settled
    return (a if isinstance(a, Tracer) else b).combine(op, a, b)


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
