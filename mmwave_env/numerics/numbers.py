"""Elementary functions of numbers, whatever a number is: a float, an array, or eight lanes.

The mathematics of this package is written once, as plain functions of numbers. On floats
it is the reference that tests call; on arrays it checks the paths of recordings and scores whole
tracks; on :class:`~mmwave_env.compiler.lanes.Lanes` it becomes one SIMD kernel. Python's own
operators serve all three; this module holds the few functions that need to look.

Shapes of arrays stand beside each argument and attribute. Functions of numbers follow three
rules: no branch on a value (use :func:`where`), lists instead of arrays, and no call to ``math``
or ``numpy`` but through this module.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Number: TypeAlias = Any  # float, numpy array or Lanes
Vector: TypeAlias = Sequence[Any]  # of Number
Matrix: TypeAlias = Sequence[Sequence[Any]]

PI = math.pi


def _is_float(a: Number) -> bool:
    return isinstance(a, (float, int))


def _function(name: str) -> Callable[[Number], Number]:
    """A function of one number, by what ``math``, numpy and lanes call it."""
    of_float, of_array = getattr(math, name), getattr(np, name)

    def function(a: Number) -> Number:
        if _is_float(a):
            return float(of_float(a))
        return of_array(a) if isinstance(a, np.ndarray) else getattr(a, name)()

    return function


sqrt, exp, floor = _function("sqrt"), _function("exp"), _function("floor")
log = _function("log")  # of a positive number


def atan2(y: Number, x: Number) -> Number:
    """Angle of the vector (x, y) in radians, in (-pi, pi]: -0 counts as 0."""
    if _is_float(y) and _is_float(x):
        return math.atan2(y + 0.0, x + 0.0)
    if isinstance(y, np.ndarray) or isinstance(x, np.ndarray):
        return np.arctan2(np.add(y, 0.0), np.add(x, 0.0))
    return (x.constant(y) if _is_float(y) else y).atan2(x)


def cos_sin(angle: Number) -> tuple[Number, Number]:
    """Cosine and sine of an angle in radians; on lanes of up to 1e5 radians."""
    if _is_float(angle):
        return math.cos(angle), math.sin(angle)
    if isinstance(angle, np.ndarray):
        return np.cos(angle), np.sin(angle)
    cosine, sine = angle.cos_sin()
    return cosine, sine


def where(condition: Any, a: Number, b: Number) -> Number:
    """``a`` where the condition holds, else ``b``: the only branch on a value there is."""
    if isinstance(condition, (bool, np.bool_)):
        return a if condition else b
    if isinstance(condition, np.ndarray):
        return np.where(condition, a, b)
    return condition.select(a, b)


def minimum(a: Number, b: Number) -> Number:
    """The smaller of two numbers."""
    return where(a < b, a, b)


def maximum(a: Number, b: Number) -> Number:
    """The larger of two numbers."""
    return where(a > b, a, b)


def clip(a: Number, low: float, high: float) -> Number:
    """The number, moved into [low, high]."""
    return minimum(maximum(a, low), high)


def wrap(angle: Number) -> Number:
    """An angle in (-3 pi, 3 pi) moved into [-pi, pi]: the difference of two angles, wrapped."""
    angle = where(angle > PI, angle - 2 * PI, angle)
    return where(angle < -PI, angle + 2 * PI, angle)


def polynomial(z: Number, coefficients: Sequence[float]) -> Number:
    """Horner's rule, highest power first."""
    value: Number = coefficients[0]
    for c in coefficients[1:]:
        value = value * z + c
    return value
