"""Sampling of a track for its picture."""

from collections.abc import Sequence

import numpy as np

from experiments.figures.trajectory import DrawnTrack
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.numerics.numbers import Array

_POINTS = 6000  # most points of a picture; a long track has at least half as many
_POSITION = [0, 1, 3, 1, 2, 4, 3, 4, 5]  # position's part of a packed covariance


class Thinned:
    """Every n-th row of a stream, where n is a power of two that grows with the stream.

    Args:
        columns: number of columns.
        most: most rows to keep; a long stream keeps at least half as many.

    Attributes:
        rows: (kept, columns) rows of the stream.
        every: n, the step between the rows that are kept.
    """

    def __init__(self, columns: int, most: int) -> None:
        self.rows, self.every = np.empty((0, columns)), 1
        self._most, self._taken = most, 0

    def add(self, rows: Array) -> None:
        """Add rows (n, columns) of the stream."""
        self.rows = np.concatenate([self.rows, rows[-self._taken % self.every :: self.every]])
        self._taken += len(rows)
        while len(self.rows) > self._most:
            self.rows, self.every = self.rows[::2], 2 * self.every


class TrackSampler:
    """Every n-th epoch of a track, where n grows with the length of the track.

    Args:
        modes: names of the modes.
        anchors_m: (L, 3) positions of anchors, the physical gNB first.
    """

    def __init__(self, modes: Sequence[str], anchors_m: Array) -> None:
        self._modes, self._anchors_m = list(modes), anchors_m
        # time, mode, segment, position, truth, covariance
        self._kept = Thinned(18, _POINTS)

    def add(self, block: TrackBlock, truth: Array | None) -> None:
        """Add a block and its true positions (T, 3), NaN where not known."""
        if truth is None:
            truth = np.full((len(block), 3), np.nan)
        self._kept.add(np.column_stack([
            block.time_s, block.mode, np.full(len(block), block.segment),
            block.smooth_x[:, :3], truth, block.smooth_P[:, _POSITION],
        ]))  # fmt: skip

    @property
    def track(self) -> DrawnTrack:
        """Return the sampled track for drawing."""
        kept = self._kept.rows
        return DrawnTrack(
            kept[:, 0], kept[:, 3:6], kept[:, 9:].reshape(-1, 3, 3), kept[:, 6:9],
            kept[:, 1].astype(np.int64), kept[:, 2].astype(np.int64),
            self._modes, self._anchors_m, whole=self._kept.every == 1,
        )  # fmt: skip
