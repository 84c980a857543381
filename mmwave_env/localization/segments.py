"""Segments of a log, each tracked separately.

A filter can predict for some seconds without a link. After half a minute, its estimate is often far
from the user, and the covariance is too small. So a segment ends after a long gap. The next segment
begins with the next epoch that determines a position (``starts.py``). After a start, and after a
shorter gap, in which a filter becomes ready to believe anything, the positions of some epochs are
compared: a track that they contradict ends, and another one begins. So does a track that has lost
the user, as in a turn between two epochs: where most links are far from it but agree on a position.
"""

from collections.abc import Collection, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mmwave_env.localization.starts import Start, ballot_of, start_at
from mmwave_env.logs.log import Log
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index

DOUBTFUL_GAP_S = 10.0  # the first epochs after a gap of this length are doubted like a start
_LOST_NIS = 28.5  # exceeded by the four values of a link once in 100,000 epochs


class Segment(NamedTuple):
    """Epochs that are tracked together."""

    epochs: slice
    start: Start


def segments(log: Log, scene: Scene, radio: Radio) -> list[Segment]:
    """Return the segments of a log.

    A segment ends if all links and odometry are missing for more than ``GAP_S``, or before an epoch
    that the log marks in ``restarts``, or where the first epochs contradict a start.

    Raises:
        LogError: the log is damaged, and no epoch before the damage determines a position.
        ValueError: no epoch determines a position with which a track could begin.
    """
    links = log.visible_links.any(axis=1)
    doubtful = np.flatnonzero((_gaps(log) > DOUBTFUL_GAP_S) & links)
    parts = [
        part
        for stretch in stretches(log, scene, radio)
        for part in _divided(log, stretch, doubtful, scene, radio)
    ]
    if not parts:
        raise log.damage or ValueError(
            f"log: found {len(log)} epochs, none of which determines a position, expected links "
            "that together determine a single position, with ranges, azimuths or both, and no "
            "anchor straight above or below the user; without azimuths, anchors on a line leave "
            "two positions, between which side in the scene, or --start, decides"
        )
    return parts


def stretches(log: Log, scene: Scene, radio: Radio) -> Iterator[Segment]:
    """Yield the epochs between long gaps, from the first on that determines a position.

    Other than :func:`segments`, these may contain epochs that contradict a start.
    """
    ends = np.flatnonzero((_gaps(log) > GAP_S) | log.restarts).tolist()
    for first, end in pairwise([0, *ends, len(log)]):
        begin, start = _begun(log, first, end, scene, radio)
        if start:
            yield Segment(slice(begin, end), start)


def _divided(
    log: Log, stretch: Segment, doubtful: Index, scene: Scene, radio: Radio
) -> Iterator[Segment]:
    """Yield the segments of epochs without a long gap."""
    begin = stretch.epochs.start
    end = stretch.epochs.stop
    start: Start | None = stretch.start
    while start:
        ballot = ballot_of(log, begin, end, scene, radio)
        start = ballot.start(log, begin) or start
        cut = ballot.jump()
        for gap in doubtful[(doubtful > begin) & (doubtful < end)].tolist():
            if cut:
                break
            ballot = ballot_of(log, gap, end, scene, radio)
            cut = gap if ballot.start(log, gap) else ballot.jump()
        yield Segment(slice(begin, cut or end), start)
        begin, start = _begun(log, cut or end, end, scene, radio)


def _begun(log: Log, first: int, end: int, scene: Scene, radio: Radio) -> tuple[int, Start | None]:
    """Return the first epoch that determines a position, and the start there; else end, None."""
    visible = log.visible[first:end, : log.layout.anchors].any(axis=1)
    for epoch in (np.flatnonzero(visible) + first).tolist():
        start = start_at(log, epoch, scene, radio)
        if start:
            return epoch, start
    return end, None


def is_lost(nis: Collection[float]) -> bool:
    """Tell whether the NIS of most of an epoch's groups say that a filter has lost the user."""
    far = sum(value > _LOST_NIS for value in nis)
    return far > 1 and 2 * far > len(nis)


def begun_again(
    log: Log, nis: Array, begins: bool, scene: Scene, radio: Radio
) -> tuple[int, Start] | None:
    """Return the first epoch that shows that a track is lost, and a start there; or None.

    ``nis`` (T, groups) is the NIS in a filter that has tracked the epochs of the log. If the track
    ``begins`` with the first of them, it is not lost there.
    """
    for epoch in np.flatnonzero((nis > _LOST_NIS).any(axis=1)).tolist():
        if (epoch or not begins) and is_lost(nis[epoch, log.visible[epoch]]):
            alone = log.part(slice(epoch, epoch + 1))
            start = start_at(alone, 0, scene, radio, sure=True)
            if start:
                return epoch, start
    return None


def _gaps(log: Log) -> Index:
    """Return how long (T,), s, before each epoch the last link or odometry was measured."""
    measured = log.visible_links.any(axis=1)
    if log.layout.odometry:  # with odometry alone, a filter keeps the track for two minutes
        measured |= log.visible[:, -1]
    latest = np.maximum.accumulate(np.where(measured, log.time_s, -np.inf))
    return np.append(0.0, log.time_s[1:] - latest[:-1])
