"""The modes that N environments chose in their latest steps."""

import numpy as np
from numpy.typing import NDArray

from mmwave_env.numerics.arrays import Index

Modes = NDArray[np.unsignedinteger]


class ActionHistory:
    """A ring buffer of the modes of the last T steps of n environments, one row per step.

    All environments step together, so an episode of k steps so far used the last k rows.

    Attributes:
        rows: (T, n) modes, in the smallest type that holds their number.
        turn: the row that the modes of the next step are to be written to.
    """

    def __init__(self, n: int, modes: int) -> None:
        self.rows: Modes = np.zeros((0, n), np.min_scalar_type(modes))
        self.turn = 0

    def make_room(self, steps: int) -> None:
        """Make T at least this many steps; the modes stored so far are kept."""
        known = len(self.rows)
        if steps > known:
            longer = np.zeros((steps, self.rows.shape[1]), self.rows.dtype)
            longer[self._last(known) % steps] = self.rows[self._last(known) % known]
            self.rows = longer

    def next(self) -> None:
        """Go on to the next row, once the modes of a step are written."""
        self.turn = (self.turn + 1) % len(self.rows)

    def of(self, places: Index, steps: int) -> Modes:
        """The modes (places, steps) of the last steps, at most T, of some environments."""
        rows = self._last(steps) % len(self.rows)
        return np.ascontiguousarray(self.rows[:, places][rows].T)

    def all(self) -> Modes:
        """The modes (T, n) of the last T steps, oldest first; 0 where there was no step yet."""
        return self.rows[self._last(len(self.rows)) % len(self.rows)]

    def set_all(self, modes: Modes) -> None:
        """Restore the modes (T, n) that :meth:`all` returned."""
        self.rows, self.turn = modes.astype(self.rows.dtype), 0

    def _last(self, steps: int) -> Index:
        return np.arange(self.turn - steps, self.turn)
