"""Fast stops and pull-aways in the truth of episodes, and the epochs around them.

Nothing that a policy does changes them, so all contenders have the same events. A pull-away is that
of a vehicle: the user has stood for 3 s, below 0.3 m/s, begins to move, above 0.5 m/s, and exceeds
2 m/s within 5 s, so that a pedestrian does not count. A stop is the same backwards in time: the
last epoch above 0.5 m/s.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.metrics import BURN_IN
from mmwave_env.numerics.arrays import Array, Index, Mask
from mmwave_env.world.episode import Episode

MOVING_MPS = 0.5
STILL_MPS, STILL_S = 0.3, 3.0  # how slow, and for how long
FAST_MPS, FAST_S = 2.0, 5.0  # how fast, and how soon


def velocities(episodes: Sequence[Episode]) -> Array:
    """True velocities (n, T, 3) of episodes of one length, m/s.

    Raises:
        ValueError: an episode has no truth.
    """
    for episode in episodes:
        episode.require_truth()
    return np.stack([np.asarray(episode.truth_velocity_mps) for episode in episodes])


def speeds(velocity_mps: Array) -> Array:
    """Horizontal speeds (n, T), of velocities (n, T, 3), m/s."""
    speed: Array = np.hypot(velocity_mps[..., 0], velocity_mps[..., 1])
    return speed


def fast_pull_aways(speed_mps: Array, step_s: float) -> Mask:
    """Epochs (n, T) in which vehicles pull away, from true speeds (n, T) of users."""
    n, T = speed_mps.shape
    enough, soon = max(1, round(STILL_S / step_s)), round(FAST_S / step_s)
    still, stands = np.zeros(n, np.int64), np.zeros(n, bool)
    found = np.zeros((n, T), bool)
    for t, speed in enumerate(speed_mps.T):
        moves = speed > MOVING_MPS
        found[:, t] = stands & moves & (speed_mps[:, t : t + soon + 1] > FAST_MPS).any(axis=1)
        still = np.where(speed < STILL_MPS, still + 1, 0)
        stands = (stands & ~moves) | (still >= enough)
    return found


def fast_stops(speed_mps: Array, step_s: float) -> Mask:
    """Epochs (n, T) in which vehicles come to a stop: a pull-away backwards in time."""
    return fast_pull_aways(speed_mps[:, ::-1], step_s)[:, ::-1]


class Windows(NamedTuple):
    """Epochs around m events, w each; of those that do not count only their number is known.

    Attributes:
        place: (m,) episode of each event.
        epoch: (m, w) epochs around it; 0 where they do not count.
        counts: (m, w) whether they are in the episode and past its burn-in.
    """

    place: Index
    epoch: Index
    counts: Mask

    @classmethod
    def around(cls, events: Mask, offsets: Index) -> "Windows":
        """Around events (n, T), epochs at offsets (w,) from them."""
        place, at = np.nonzero(events)
        epoch = at[:, None] + offsets
        counts = (epoch >= BURN_IN) & (epoch < events.shape[1])
        return cls(place, np.where(counts, epoch, 0), counts)

    def sums(self, values: Array) -> Array:
        """Sums (n, w) over the events of each episode, of values (n, T)."""
        found = np.zeros((len(values), self.epoch.shape[1]))
        np.add.at(found, self.place, values[self.place[:, None], self.epoch] * self.counts)
        return found
