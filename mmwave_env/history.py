"""Which modes N environments chose lately."""

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]
Modes = NDArray[np.unsignedinteger]


class History:
    """The modes of the last T steps of N environments, a row a step.

    All environments step at once, so an episode that took some steps took the last ones.

    Args:
        n: number of environments.
        modes: how many there are to choose from.
    """

    def __init__(self, n: int, modes: int) -> None:
        self._rows: Modes = np.zeros((0, n), np.min_scalar_type(modes))
        self._count = 0  # step s is in row s modulo T

    def make_room(self, steps: int) -> None:
        """Let T be at least so many steps; what is known stays known."""
        known = len(self._rows)
        if steps > known:
            longer = np.zeros((steps, self._rows.shape[1]), self._rows.dtype)
            longer[self._last(known) % steps] = self._rows[self._last(known) % known]
            self._rows = longer

    def note(self, actions: Index) -> None:
        """A step with modes (n,)."""
        self._rows[self._count % len(self._rows)] = actions
        self._count += 1

    def of(self, places: Index, steps: int) -> Modes:
        """The modes (places, steps) of the last steps, at most T, in some environments."""
        rows = self._last(steps) % len(self._rows)
        return np.ascontiguousarray(self._rows[:, places][rows].T)

    def all(self) -> Modes:
        """The modes (T, n) of the last steps, oldest first; those before the first one are 0."""
        return self._rows[self._last(len(self._rows)) % len(self._rows)]

    def _last(self, steps: int) -> Index:
        return np.arange(self._count - steps, self._count)
