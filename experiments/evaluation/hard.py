"""Hard sites of the benchmark: streets with motion or receivers that no filter is designed for."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode
from mmwave_env.world.keys import Keys
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.trajectory import Trajectory

DURATION_S = 800  # duration of a trajectory, s; an episode is a random window of 200 s
STREET = SCENES["street"]
HANDSET = RADIOS["handset"]


@dataclass(frozen=True)
class Misstated(SimulatedSource):
    """A source of episodes whose receiver misstates its noise by a constant factor."""

    stated: float = 1.0  # ratio of stated to true standard deviations

    def episodes(self, keys: Keys) -> list[Episode]:
        """Return the episodes that ``keys`` (n,) determine, with misstated noise."""
        episodes = super().episodes(keys)
        return [replace(episode, sigma=self.stated * episode.sigma) for episode in episodes]


def corners() -> Trajectory:
    """Return the path of a car at 10 m/s that turns at every crossing of the default scene."""
    crossings = np.array([(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (1, 2), (1, 1), (0, 1)])
    block_s = round(STREET.streets.block_m / 10.0)
    nodes = STREET.streets.block_m * np.resize(crossings, (DURATION_S // block_s + 1, 2))
    x, y = (np.interp(np.arange(DURATION_S), block_s * np.arange(len(nodes)), n) for n in nodes.T)
    return _trajectory("corners", x, y + STREET.streets.y_m[0])


def bus() -> Trajectory:
    """Return the path of a bus that goes back and forth and stops for 15 s every 300 m."""
    speed_mps = np.interp(np.arange(50), [0, 10, 25, 35], [0, 12, 12, 0])
    gone = np.cumsum(np.resize(speed_mps, DURATION_S)) % 600.0
    x = np.minimum(gone, 600.0 - gone) - 150.0
    return _trajectory("bus", x, np.zeros(len(x)))


def _trajectory(name: str, x: Array, y: Array) -> Trajectory:
    height_m = np.full(len(x), STREET.streets.height_m)
    return Trajectory(name, np.arange(len(x), dtype=float), np.stack([x, y, height_m], axis=1))


HARD_SOURCES: dict[str, Callable[[], SimulatedSource]] = {
    "corners:handset": lambda: SimulatedSource(STREET, HANDSET, corners()),
    "bus:standard": lambda: SimulatedSource(SCENES["dynamic-doppler"], RADIOS["standard"], bus()),
    "noise-twice:handset": lambda: Misstated(STREET, HANDSET, stated=0.5),
    "clock-offset:handset": lambda: SimulatedSource(STREET, HANDSET, clock=True),
    "range-azimuth:handset": lambda: SimulatedSource(
        STREET, HANDSET, measurements=("range", "azimuth")
    ),
}
