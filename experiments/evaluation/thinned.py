"""Some of very many rows, evenly taken, for a picture."""

import numpy as np

from mmwave_env.numerics.arrays import Array


class Thinned:
    """Every n-th of the rows that come, with n a power of two as their number demands.

    Args:
        columns: of a row.
        most: rows that are kept; at least half as many are, where there were that many.

    Attributes:
        rows: (kept, columns).
        every: which of them were kept: every so manieth.
    """

    def __init__(self, columns: int, most: int) -> None:
        self.rows, self.every = np.empty((0, columns)), 1
        self._most, self._taken = most, 0

    def add(self, rows: Array) -> None:
        """Take more rows (n, columns)."""
        self.rows = np.concatenate([self.rows, rows[-self._taken % self.every :: self.every]])
        self._taken += len(rows)
        while len(self.rows) > self._most:
            self.rows, self.every = self.rows[::2], 2 * self.every
