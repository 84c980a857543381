"""Where a user was, by time."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mmwave_env.logs.tum import Poses, tum_blocks
from mmwave_env.numerics.arrays import Array

TOLERANCE_S = 0.01  # evo's default


def tolerance_s(time_s: Array) -> float:
    """How far poses may be from epochs at times (T,), s.

    At most half a step, so that no pose counts twice.
    """
    half = 0.5 * np.median(np.diff(time_s)) if len(time_s) > 1 else np.inf
    return min(TOLERANCE_S, float(half))


class Truth:
    """True positions by time, from a TUM file that is read as far as it is needed.

    Args:
        path: of the file.

    Attributes:
        path: of the file.
        first_s: its first time.
        last_s: the last time read so far.

    Raises:
        ValueError, OSError: as :func:`~mmwave_env.logs.tum.tum_blocks`, methods too.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._blocks = tum_blocks(path)
        self._near = [next(self._blocks)]
        self.first_s, self.last_s = (float(self._near[0].time_s[i]) for i in (0, -1))

    def at(self, time_s: Array, tolerance_s: float = TOLERANCE_S) -> Array:
        """Positions (T, 3) nearest to times (T,); NaN where none is within the tolerance.

        Times must increase, also from call to call.
        """
        position, distance = np.full((len(time_s), 3), np.nan), np.full(len(time_s), np.inf)
        for poses in self._until(time_s[-1] + tolerance_s):
            after = np.searchsorted(poses.time_s, time_s)
            for index in (np.maximum(after - 1, 0), np.minimum(after, len(poses.time_s) - 1)):
                away = np.abs(poses.time_s[index] - time_s)
                nearer = (away < distance) & (away <= tolerance_s)
                distance[nearer] = away[nearer]
                position[nearer] = poses.position_m[index[nearer]]
        self._near = [p for p in self._near if p.time_s[-1] >= time_s[-1] - tolerance_s]
        return position

    def _until(self, time_s: float) -> Iterator[Poses]:
        """The poses kept, and more, up to a time; of those read, the last two blocks are kept."""
        yield from self._near
        while self.last_s < time_s and (poses := next(self._blocks, None)):
            self.last_s = float(poses.time_s[-1])
            self._near = [*self._near[-1:], poses]
            yield poses

    def read_on(self) -> None:
        """Read to the end, for ``last_s``."""
        for poses in self._blocks:
            self.last_s = float(poses.time_s[-1])

    def no_match(self, first_s: float, last_s: float) -> ValueError:
        """The error of a truth without a pose at the epochs of a log from ``first_s`` on."""
        self.read_on()
        return ValueError(
            f"{self.path}: found times from {self.first_s!r} to {self.last_s!r} s, expected some "
            f"within {TOLERANCE_S} s of the log's, which are from {first_s!r} to {last_s!r} s"
        )

    def warn_if_few(self, matched: int, epochs: int, first_s: float, last_s: float) -> None:
        """Warn where less than half of a log's epochs have a pose: another clock, or unit."""
        if 2 * matched >= epochs:
            return
        self.read_on()
        warnings.warn(
            f"{self.path}: found a true position for {matched} of the log's {epochs} epochs, "
            f"expected half at least; the log's times are {first_s:.10g} to {last_s:.10g} s, the "
            f"truth's {self.first_s:.10g} to {self.last_s:.10g} s: are both in seconds?",
            stacklevel=3,
        )
