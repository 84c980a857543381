"""Kinds of actions: a mode's number, weights of the modes, or a correction of the belief."""

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.error import InvalidAction
from numpy.typing import NDArray

from mmwave_env.filters.correction import MOST_LOG_FACTOR, MOST_SHIFT
from mmwave_env.filters.imm import TRUST
from mmwave_env.io.lookup import quoted
from mmwave_env.numerics.numbers import Array

MODE = "mode"
WEIGHTS = "weights"
CORRECTION = "correction"
ACTIONS = {
    MODE: "the mode to run or, if each mode has a belief, the mode whose probability is raised",
    WEIGHTS: "a number w for each mode, whose probability is multiplied by exp(w) per second",
    CORRECTION: "three shifts of the position, and log factors on its three standard deviations",
}


def limits_of(action: str, modes: int) -> Array:
    """Return the largest absolute values (k,) of an action's numbers; k is 0 for the kind MODE."""
    if action == WEIGHTS:
        return np.full(modes, TRUST)
    return np.repeat([MOST_SHIFT, MOST_LOG_FACTOR], 3) if action == CORRECTION else np.zeros(0)


def space_of(limits: Array, count: int) -> spaces.Space[Any]:
    """Return the space of k numbers with these limits (k,), or of ``count`` modes if k is 0."""
    if not len(limits):
        return spaces.Discrete(count)
    most = limits.astype(np.float32)
    return spaces.Box(-most, most, dtype=np.float32)


def numbers_in(name: str, action: Any, limits: Array, *n: int, ignored: Any = False) -> Array:
    """Return a copy of an action's numbers (*n, k), with 0 where the mask ``ignored`` is True.

    Raises:
        InvalidAction: the shape differs, or a number is NaN or beyond its limit.
    """
    array: NDArray[Any] = np.asarray(action)
    if array.shape == (*n, len(limits)) and array.dtype.kind in "fiu":
        numbers = array.astype(np.float64)
        numbers[ignored] = 0.0
        if (np.abs(numbers) <= limits).all():
            return numbers
    raise InvalidAction(
        f"{name}: found {quoted(array.tolist())} of shape {array.shape}, expected numbers of shape "
        f"{(*n, len(limits))}, none of them NaN or beyond ±{limits.tolist()}"
    )
