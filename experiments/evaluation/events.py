"""Events in the recorded truth and links of episodes, and what happens around them.

Nothing that a policy does changes them, so all contenders have the same events. A user stands
below 0.1 m/s and moves above 0.5 m/s; in between, it goes on with what it did.

- A stop is the first epoch in which it stands after it moved, a pull-away the first in which it
  moves after it stood.
- A turn is the first epoch whose heading is more than 45 degrees away from one within the 3 s
  before, if the user moved all along.
- Blockage begins in an epoch with fewer visible links than the one before.

Fast pull-aways are those of vehicles: the user has stood for 3 s, below 0.3 m/s, and exceeds
2 m/s within 5 s, so a pedestrian does not. A fast stop is the same backwards in time: the last
epoch above 0.5 m/s.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.episodes.episode import Episode
from mmwave_env.metrics import BURN_IN
from mmwave_env.numerics.arrays import Array, Index, Mask

STANDING_MPS, MOVING_MPS = 0.1, 0.5
TURN_RAD, TURN_S = np.pi / 4, 3.0
STILL_MPS, STILL_S = 0.3, 3.0  # of fast ones: how slow, and for how long
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


def visible_links(episodes: Sequence[Episode]) -> Index:
    """How many links can be used (n, T), in episodes of one length."""
    return np.stack([e.usable[:, : e.layout.anchors].sum(axis=1) for e in episodes])


def stops(speed_mps: Array) -> Mask:
    """Epochs (n, T) in which users come to stand, from their true speeds (n, T)."""
    return _first(speed_mps < STANDING_MPS, after=speed_mps > MOVING_MPS)


def pull_aways(speed_mps: Array) -> Mask:
    """Epochs (n, T) in which users begin to move, from their true speeds (n, T)."""
    return _first(speed_mps > MOVING_MPS, after=speed_mps < STANDING_MPS)


def turns(velocity_mps: Array, step_s: float) -> Mask:
    """Epochs (n, T) in which users have turned, from their true velocities (n, T, 3)."""
    moves = speeds(velocity_mps) > MOVING_MPS
    direction = velocity_mps[..., 0] + 1j * velocity_mps[..., 1]
    moved, turned = moves.copy(), np.zeros_like(moves)
    for back in range(1, max(1, round(TURN_S / step_s)) + 1):
        moved = moved[:, 1:] & moves[:, :-back]  # in all epochs from the one before to this
        change = np.angle(direction[:, back:] * direction[:, :-back].conj())
        turned[:, back:] |= moved & (abs(change) > TURN_RAD)
    return _first(turned, after=~turned)


def blockages(links: Index) -> Mask:
    """Epochs (n, T) in which blockage begins, from how many links are visible (n, T)."""
    fewer: Mask = np.diff(links, axis=1, prepend=links[:, :1]) < 0
    return fewer


def _first(there: Mask, after: Mask) -> Mask:
    """Epochs (n, T) that are the first there after one of the others; both exclude each other."""
    waits, found = np.zeros(len(there), bool), np.zeros_like(there)
    for t in range(there.shape[1]):
        found[:, t] = waits & there[:, t]
        waits = (waits & ~there[:, t]) | after[:, t]
    return found


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
