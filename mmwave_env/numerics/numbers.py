"""Elementary functions of numbers, where a number is a float, an array or eight SIMD lanes.

The mathematics of this package is written once, as plain functions of numbers. Called with floats,
these functions are the reference for tests. Called with arrays, they check propagation paths
and score complete tracks. Called with lanes (:mod:`mmwave_env.compiler.lanes`), they become a
SIMD kernel. Python's operators work on all three kinds; the other elementary functions are here.

In this package, the description of an array begins with its shape. Functions of numbers follow
three rules: they do not branch on a value (use :func:`where`), they use lists instead of arrays,
and they call ``math`` or ``numpy`` only through this module.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Number: TypeAlias = Any  # float, numpy array or lanes
Numbers: TypeAlias = list[Any]  # a list of Number
Pair: TypeAlias = tuple[Any, Any]  # two of Number
Vector: TypeAlias = Sequence[Any]  # a sequence of Number
Matrix: TypeAlias = Sequence[Sequence[Any]]  # a sequence of rows

PI = math.pi


def _is_float(a: Number) -> bool:
    return isinstance(a, (float, int))


def _function(name: str, module: Any = math) -> Callable[[Number], Number]:
    """Return a function for all kinds of numbers; floats use ``name`` of ``module``."""
    of_float = getattr(module, name)
    of_array = getattr(np, name)

    def function(a: Number) -> Number:
        if _is_float(a):
            return float(of_float(a))
        return of_array(a) if isinstance(a, np.ndarray) else getattr(a, name)()

    return function


sqrt = _function("sqrt")
floor = _function("floor")
exp = _function("exp", np)  # numpy also for floats, so that floats and arrays get the same bits
log = _function("log")  # for positive numbers only
_cos = _function("cos")
_sin = _function("sin")


def atan2(y: Number, x: Number) -> Number:
    """Return the angle of the vector (x, y) in radians, in (-pi, pi]; -0.0 counts as 0.0."""
    if _is_float(y) and _is_float(x):
        return math.atan2(y + 0.0, x + 0.0)
    if isinstance(y, np.ndarray) or isinstance(x, np.ndarray):
        return np.arctan2(np.add(y, 0.0), np.add(x, 0.0))
    return x.atan2_of(y) if _is_float(y) else y.atan2(x)


def cos_sin(angle: Number) -> Pair:
    """Return cosine and sine of an angle in radians; on lanes, the angle must be in [-1e5, 1e5]."""
    return _cos(angle), _sin(angle)


def where(condition: Any, a: Number, b: Number) -> Number:
    """Return ``a`` where the condition is true, else ``b``."""
    if isinstance(condition, (bool, np.bool_)):
        return a if condition else b
    if isinstance(condition, np.ndarray):
        return np.where(condition, a, b)
    return condition.select(a, b)


def minimum(a: Number, b: Number) -> Number:
    """Return the smaller of two numbers."""
    return where(a < b, a, b)


def maximum(a: Number, b: Number) -> Number:
    """Return the larger of two numbers."""
    return where(a > b, a, b)


def clip(a: Number, low: float, high: float) -> Number:
    """Return the number, limited to [low, high]."""
    return minimum(maximum(a, low), high)


def blend(keep: Number, old: Number, new: Number) -> Number:
    """Return the next value of a moving average, in which the past has the weight ``keep``."""
    return keep * old + (1.0 - keep) * new


def wrap(angle: Number) -> Number:
    """Wrap an angle in (-3 pi, 3 pi), such as a difference of two angles, into [-pi, pi]."""
    angle = where(angle > PI, angle - 2 * PI, angle)
    return where(angle < -PI, angle + 2 * PI, angle)


def polynomial(z: Number, coefficients: Sequence[float]) -> Number:
    """Evaluate a polynomial by Horner's rule; the coefficient of the highest power comes first."""
    value: Number = coefficients[0]
    for c in coefficients[1:]:
        value = value * z + c
    return value
