"""Which modes N environments chose lately."""

import numpy as np
from numpy.typing import NDArray

from mmwave_env.numerics.arrays import Index

Modes = NDArray[np.unsignedinteger]


class ActionHistory:
    """The modes of the last T steps of N environments, a row a step.

    All environments step at once, so an episode that took some steps took the last ones.

    Args:
        n: number of environments.
        modes: how many there are to choose from.

    Attributes:
        rows: (T, n) modes.
        turn: the row of the next step, whose modes are to be written there.
    """

    def __init__(self, n: int, modes: int) -> None:
        self.rows: Modes = np.zeros((0, n), np.min_scalar_type(modes))
        self.turn = 0

    def make_room(self, steps: int) -> None:
        """Let T be at least so many steps; what is known stays known."""
        known = len(self.rows)
        if steps > known:
            longer = np.zeros((steps, self.rows.shape[1]), self.rows.dtype)
            longer[self._last(known) % steps] = self.rows[self._last(known) % known]
            self.rows = longer

    def next(self) -> None:
        """The modes of a step are written."""
        self.turn = (self.turn + 1) % len(self.rows)

    def of(self, places: Index, steps: int) -> Modes:
        """The modes (places, steps) of the last steps, at most T, in some environments."""
        rows = self._last(steps) % len(self.rows)
        return np.ascontiguousarray(self.rows[:, places][rows].T)

    def all(self) -> Modes:
        """The modes (T, n) of the last steps, oldest first; those before the first one are 0."""
        return self.rows[self._last(len(self.rows)) % len(self.rows)]

    def set_all(self, modes: Modes) -> None:
        """Know what :meth:`all` gave."""
        self.rows, self.turn = modes.astype(self.rows.dtype), 0

    def _last(self, steps: int) -> Index:
        return np.arange(self.turn - steps, self.turn)
