"""What is kept of a track for its picture."""

from collections.abc import Sequence

import numpy as np

from experiments.figures.trajectory import DrawnTrack
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.numerics.numbers import Array

_POINTS = 6000  # kept of a track of any length, at least half of them
_POSITION = [0, 1, 3, 1, 2, 4, 3, 4, 5]  # its covariance in a packed one, row by row


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


class TrackSampler:
    """Every n-th epoch of a track, with n as the length of the track demands.

    Args:
        modes: their names.
        anchors_m: (L, 3), the physical gNB first.
    """

    def __init__(self, modes: Sequence[str], anchors_m: Array) -> None:
        self._modes, self._anchors_m = list(modes), anchors_m
        # time, mode, segment, position, truth, covariance
        self._kept = Thinned(18, _POINTS)

    def add(self, block: TrackBlock, truth: Array | None) -> None:
        """Take a block and its true positions (T, 3), NaN where not known."""
        if truth is None:
            truth = np.full((len(block), 3), np.nan)
        self._kept.add(np.column_stack([
            block.time_s, block.mode, np.full(len(block), block.segment),
            block.smooth_x[:, :3], truth, block.smooth_P[:, _POSITION],
        ]))  # fmt: skip

    @property
    def track(self) -> DrawnTrack:
        """What was kept."""
        kept = self._kept.rows
        return DrawnTrack(
            kept[:, 0], kept[:, 3:6], kept[:, 9:].reshape(-1, 3, 3), kept[:, 6:9],
            kept[:, 1].astype(np.int64), kept[:, 2].astype(np.int64),
            self._modes, self._anchors_m, whole=self._kept.every == 1,
        )  # fmt: skip
