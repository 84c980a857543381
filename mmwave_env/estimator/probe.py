"""Floats that hide their value as lanes do, to try a function before it is compiled."""

import operator
from collections.abc import Callable
from typing import Any

from mmwave_env import arithmetic
from mmwave_env.estimator.hidden import Hidden, HiddenTruth

_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip


class ProbeTruth(HiddenTruth):
    """A condition on probes."""

    __slots__ = ("hidden",)

    def __init__(self, hidden: bool) -> None:
        self.hidden = hidden

    def __and__(self, other: "ProbeTruth") -> "ProbeTruth":
        return ProbeTruth(self.hidden & other.hidden)

    def __or__(self, other: "ProbeTruth") -> "ProbeTruth":
        return ProbeTruth(self.hidden | other.hidden)

    def select(self, a: Any, b: Any) -> "Probe":
        """``a`` where the condition holds, else ``b``."""
        return Probe(arithmetic.where(self.hidden, value_of(a), value_of(b)))


class Probe(Hidden):
    """A float that hides its value and does with it what lanes do with theirs."""

    __slots__ = ("hidden",)

    def __init__(self, hidden: float) -> None:
        self.hidden = hidden

    def combine(self, op: str, a: Any, b: Any) -> "Probe":
        """``a op b``."""
        return Probe(_OPERATORS[op](value_of(a), value_of(b)))

    def compare(self, op: str, other: Any) -> ProbeTruth:
        """``self op other``."""
        return ProbeTruth(_OPERATORS[op](self.hidden, value_of(other)))

    def __neg__(self) -> "Probe":
        return Probe(-self.hidden)

    def __abs__(self) -> "Probe":
        return Probe(abs(self.hidden))

    def constant(self, value: float) -> "Probe":
        """A value."""
        return Probe(value)

    def sqrt(self) -> "Probe":
        """Square root."""
        return Probe(arithmetic.sqrt(self.hidden))

    def log(self) -> "Probe":
        """Natural logarithm."""
        return Probe(arithmetic.log(self.hidden))

    def exp(self) -> "Probe":
        """Exponential function."""
        return Probe(arithmetic.exp(self.hidden))

    def cos_sin(self) -> "tuple[Probe, Probe]":
        """Cosine and sine."""
        cosine, sine = arithmetic.cos_sin(self.hidden)
        return Probe(cosine), Probe(sine)

    def atan2(self, x: Any) -> "Probe":
        """Angle of (x, self)."""
        return Probe(arithmetic.atan2(self.hidden, value_of(x)))


def value_of(a: Any) -> float:
    """The value of a float or a probe."""
    return a.hidden if isinstance(a, Probe) else float(a)
