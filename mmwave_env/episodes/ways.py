"""Ways that users were given to go: an episode is a window of one of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mmwave_env.numerics.arrays import Array, Index


@dataclass(frozen=True, eq=False)
class Ways:
    """K ways through a scene.

    Attributes:
        names: (K,) of those who go them.
        begin_s: (K,) when each begins, by the clock of its file.
        tables: K arrays (E, 6), positions (m) and velocities (m/s) at steps of ``dt``.
        dt: seconds between epochs.
        most: epochs of an episode; fewer where a way has fewer.
        about: what to say of how they were chosen, if anything.
    """

    names: Sequence[str]
    begin_s: Sequence[float]
    tables: Sequence[Array]
    dt: float
    most: int
    about: str = ""

    @cached_property
    def epochs(self) -> int:
        """Of an episode."""
        return min(self.most, *map(len, self.tables))

    def draw(self, choice: Array) -> tuple[Index, Array]:
        """Which ways (n,) episodes are of, and the truth (n, epochs, 6) in them.

        All ways are as likely, and all windows of one.

        Args:
            choice: (n,) uniform in [0, 1).
        """
        scaled = choice * len(self.tables)
        which = scaled.astype(np.int64)
        room = np.array([len(table) for table in self.tables])[which] - self.epochs + 1
        starts = ((scaled - which) * room).astype(np.int64)
        pairs = zip(which.tolist(), starts.tolist(), strict=True)
        truth = [self.tables[way][start : start + self.epochs] for way, start in pairs]
        return which, np.array(truth).reshape(len(choice), self.epochs, 6)

    def find(self, position_m: Array) -> tuple[str, float, float]:
        """Who went an episode's positions (E, 3), and when it begins and ends in the file.

        Raises:
            ValueError: nobody.
        """
        for name, begin_s, table in zip(self.names, self.begin_s, self.tables, strict=True):
            windows = np.lib.stride_tricks.sliding_window_view(table[:, :3], len(position_m), 0)
            same = np.flatnonzero((windows == position_m.T).all(axis=(1, 2)))
            if len(same):
                begin = begin_s + self.dt * int(same[0])
                return name, begin, begin + self.dt * (len(position_m) - 1)
        raise ValueError("position_m: found positions of no way, expected those of an episode")
