"""Numbers that take part in arithmetic but hide their value.

A function that runs on such numbers never asks for a value, so it can be compiled for SIMD lanes
(numbers that stand for eight environments). An operation that needs a value is refused, and the
message says what to write instead. There are three kinds of such numbers: lanes; probes, which are
floats that hide their value, to try a function before it is compiled; and the numbers of
:mod:`mmwave_env.compiler.fingerprint`, which record operations.
"""

from collections.abc import Callable
from operator import add, ge, gt, le, lt, mul, sub, truediv
from typing import Any, NoReturn

from mmwave_env.numerics import numbers


class NoValueError(TypeError):
    """An error in a function that asks for a hidden value; the message says what to write."""


_NUMBERS = "mmwave_env.numerics.numbers"
_REFUSALS = {  # key: (the operation in words, what to write instead)
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
    "remainder": ("a remainder", "wrap(a) for angles, where(a > b, a - b, a) for one period"),
    "floor": ("a division with //", "a / b"),
    "key": ("a key of a dict or set", "a list and a constant index, or where(condition, a, b)"),
    "mask as number": ("arithmetic with a condition", "where(condition, 1.0, 0.0)"),
    "inverse": ("the inverse of a condition", "where(condition, b, a) with exchanged branches"),
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
    __lt__, __le__ = _comparing("<"), _comparing("<=")
    __gt__, __ge__ = _comparing(">"), _comparing(">=")


def _settled(op: str, a: Any, b: Any) -> Any:
    """Return the result if a constant 0 or 1 makes an instruction unnecessary, else None."""
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


_OPERATORS: dict[str, Any] = {"add": add, "sub": sub, "mul": mul, "div": truediv}
_OPERATORS |= {"<": lt, "<=": le, ">": gt, ">=": ge}


class FloatCondition(TracerCondition):
    """A condition on probes."""

    __slots__ = ("hidden",)

    def __init__(self, hidden: bool) -> None:
        self.hidden = hidden

    def __and__(self, other: "FloatCondition") -> "FloatCondition":
        return FloatCondition(self.hidden & other.hidden)

    def __or__(self, other: "FloatCondition") -> "FloatCondition":
        return FloatCondition(self.hidden | other.hidden)

    def select(self, a: Any, b: Any) -> "FloatTracer":
        """Return ``a`` if the condition is true, else ``b``."""
        return FloatTracer(numbers.where(self.hidden, value_of(a), value_of(b)))


def _applying(function: Callable[[float], float]) -> Any:
    return lambda a: FloatTracer(function(a.hidden))


class FloatTracer(Tracer):
    """A probe: a float that hides its value, but supports the arithmetic that lanes support."""

    __slots__ = ("hidden",)

    def __init__(self, hidden: float) -> None:
        self.hidden = hidden

    def combine(self, op: str, a: Any, b: Any) -> "FloatTracer":
        """Compute ``a op b``."""
        return FloatTracer(_OPERATORS[op](value_of(a), value_of(b)))

    def compare(self, op: str, other: Any) -> FloatCondition:
        """Return the condition ``self op other``."""
        return FloatCondition(_OPERATORS[op](self.hidden, value_of(other)))

    def __neg__(self) -> "FloatTracer":
        return FloatTracer(-self.hidden)

    def __abs__(self) -> "FloatTracer":
        return FloatTracer(abs(self.hidden))

    def constant(self, value: float) -> "FloatTracer":
        """Return a probe that hides a value."""
        return FloatTracer(value)

    sqrt, log, exp = _applying(numbers.sqrt), _applying(numbers.log), _applying(numbers.exp)
    floor = _applying(numbers.floor)

    def cos_sin(self) -> "tuple[FloatTracer, FloatTracer]":
        """Return the cosine and the sine."""
        cosine, sine = numbers.cos_sin(self.hidden)
        return FloatTracer(cosine), FloatTracer(sine)

    def atan2(self, x: Any) -> "FloatTracer":
        """Return the angle of the vector (x, self)."""
        return FloatTracer(numbers.atan2(self.hidden, value_of(x)))


def value_of(a: Any) -> float:
    """Return the value of a float or a probe."""
    return a.hidden if isinstance(a, FloatTracer) else float(a)
