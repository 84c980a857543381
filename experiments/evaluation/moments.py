"""The moment of many episodes that tells two contenders best from each other.

It is a fast pull-away (:mod:`experiments.evaluation.events`) with a fast stop in the
:data:`BEFORE_S` before it. Until then both contenders are within :data:`NEAR_M` of the user, and
one of them, the keeper, for :data:`AFTER_S` longer. Of all such moments the clearest is the one
with the largest difference of the mean errors in these last seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from experiments.evaluation.contenders import Contender
from experiments.evaluation.events import fast_pull_aways, fast_stops, speeds, velocities
from experiments.evaluation.runner import EpochResults, step_s
from mmwave_env.episodes.episode import Episode
from mmwave_env.metrics import BURN_IN
from mmwave_env.numerics.arrays import Array, Index, Mask

BEFORE_S, AFTER_S = 15.0, 20.0
NEAR_M = 5.0


class Moment(NamedTuple):
    """Some epochs of one of many episodes.

    Attributes:
        place: of the episode among them.
        epochs: first and last, counted from 0.
    """

    place: int
    epochs: tuple[int, int]


@dataclass
class PullAways:
    """What two contenders made of episodes of one length, to find the clearest moment in."""

    loser: str
    keeper: str
    _speeds: list[Array] = field(default_factory=list)
    _errors: dict[str, list[Array]] = field(default_factory=dict)
    _step_s: float = 1.0

    def add(self, contender: Contender, episodes: Sequence[Episode], told: EpochResults) -> None:
        """Take what a contender told of episodes with truth."""
        if contender.name == self.loser:
            self._speeds.append(speeds(velocities(episodes)))
            self._step_s = step_s(episodes[0])
        errors = np.linalg.norm(told["error"], axis=-1)
        self._errors.setdefault(contender.name, []).append(errors)

    @property
    def clearest(self) -> Moment:
        """The clearest moment there is.

        Raises:
            ValueError: there is none.
        """
        speed = np.concatenate(self._speeds)
        lost, kept = (np.concatenate(self._errors[name]) for name in (self.loser, self.keeper))
        pulls = fast_pull_aways(speed, self._step_s)
        before, after = round(BEFORE_S / self._step_s), round(AFTER_S / self._step_s)
        place, at = _inside(pulls, max(before, BURN_IN), after)
        around = place[:, None], at[:, None] + np.arange(-before, after + 1)
        lost, kept, stops = lost[around], kept[around], fast_stops(speed, self._step_s)[around]
        fits = stops[:, :before].any(axis=1) & (lost[:, :before] < NEAR_M).all(axis=1)
        fits &= (kept < NEAR_M).all(axis=1)
        if not fits.any():
            raise ValueError(
                f"clearest: found none of {len(pulls)} episodes with a stop and a pull-away that "
                f"{self.keeper} keeps within {NEAR_M:g} m, expected one: look among more, or "
                "take --scenario vehicle"
            )
        lead = np.where(fits, (lost - kept)[:, before:].mean(axis=1), -np.inf)
        best = int(np.nanargmax(lead))
        return Moment(int(place[best]), (int(at[best]) - before, int(at[best]) + after))


def _inside(events: Mask, before: int, after: int) -> tuple[Index, Index]:
    """Episodes and epochs (m,) of events (n, T) that are so far from the ends."""
    place, at = np.nonzero(events)
    inside = (at >= before) & (at + after < events.shape[1])
    return place[inside], at[inside]
