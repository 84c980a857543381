"""A scenario in whichever files: its receivers, and which of them are the epochs of a track."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.deepmimo.paths import Paths
from mmwave_env.numerics.arrays import Array


@dataclass(frozen=True, kw_only=True)
class Scenario(ABC):
    """What a folder holds, before its arrays are read.

    Attributes:
        folder: of the scenario.
        scenes: folders with the arrays, in the order of time; of a static scenario the folder.
        stations: names of its base stations, as in those of the files.
        receivers: how many there are in every scene.
        carrier_hz: carrier frequency.
    """

    folder: Path
    scenes: tuple[Path, ...]
    stations: tuple[str, ...]
    receivers: int
    carrier_hz: float

    @abstractmethod
    def grid(self, scene: int = 0) -> Array:
        """Positions (N, 3) of all receivers in a scene, m."""

    @abstractmethod
    def positions(self, epochs: NDArray[np.int_]) -> Array:
        """Positions (E, 3) of the receivers of epochs, as of :meth:`epochs`, m."""

    @abstractmethod
    def paths(self, epochs: NDArray[np.int_], base_station: int | None = None) -> Paths:
        """The paths of some receivers.

        Args:
            epochs: (E, 2) scenes, increasing, and rows, as of :meth:`epochs`.
            base_station: number of the only one to read, from 1 in the order of ``stations``;
                None for all.

        Raises:
            FileNotFoundError: a file is missing.
            ValueError: a file can't be read or contradicts another; the message names file and
                key.
        """

    @property
    def is_dynamic(self) -> bool:
        """Whether the epochs are scenes, not receivers."""
        return self.scenes != (self.folder,)

    def name_of(self, epoch: NDArray[np.int_]) -> str:
        """The receiver of an epoch (2,), for messages."""
        scene, row = epoch.tolist()
        return f"receiver {row}" + (f" in {self.scenes[scene].name}" if self.is_dynamic else "")

    def epochs(self, users: int | Sequence[int] | NDArray[np.int_] | None) -> NDArray[np.int_]:
        """Scene and row (E, 2) of the receiver of every epoch.

        Args:
            users: rows of receivers, from 0. Of a static scenario one for each epoch, or None for
                all of them. Of a dynamic one that of every scene, or one for all scenes, or None
                where there is but one receiver.

        Raises:
            ValueError: other numbers, or another number of them.
        """
        rows = np.arange(self.receivers) if users is None else np.asarray(users)
        if rows.size == 0 or rows.dtype.kind not in "iu" or rows.ndim > 1:
            raise ValueError(f"users: found {users!r}, expected numbers of receivers")
        outside = rows[(rows < 0) | (rows >= self.receivers)]
        if outside.size:
            raise ValueError(f"users: found {outside.flat[0]}, expected 0 to {self.receivers - 1}, "
                             f"the receivers of {self.folder}")  # fmt: skip
        if not self.is_dynamic:
            return np.column_stack([np.zeros(rows.size, int), rows.reshape(-1)])
        scenes = np.arange(len(self.scenes))
        if rows.size not in (1, len(scenes)):
            raise ValueError(
                f"users: found {rows.size}, expected 1 or {len(scenes)}, one for each scene of "
                f"{self.folder}, which has {self.receivers} receivers in each"
            )
        return np.column_stack([scenes, np.broadcast_to(rows.reshape(-1), len(scenes))])

    def chosen(self, base_station: int | None) -> tuple[str, ...]:
        """The station of a number, from 1 in the order of ``stations``; all of them for None.

        Raises:
            ValueError: there is no such number.
        """
        if base_station is None:
            return self.stations
        if not 1 <= base_station <= len(self.stations):
            raise ValueError(
                f"base_station: found {base_station}, expected 1 to {len(self.stations)}: "
                f"{', '.join(self.stations)} of {self.folder}"
            )
        return self.stations[base_station - 1 : base_station]


def by_scene(epochs: NDArray[np.int_]) -> list[tuple[int, NDArray[np.int_]]]:
    """Scenes, and the rows of receivers in each, of epochs (E, 2)."""
    scenes, rows = epochs.T
    return [(int(scene), rows[scenes == scene]) for scene in np.unique(scenes)]
