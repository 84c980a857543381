"""Segments of a log, each tracked separately.

A filter can predict for some seconds without a link. After half a minute, its estimate is often far
from the user, and the covariance is too small. So a segment ends after a long gap. The next segment
begins with the next epoch that determines a position (``starts.py``). After a start, and after a
shorter gap, in which a filter becomes ready to believe anything, the positions of some epochs are
compared: a track that they contradict ends, and another one begins.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mmwave_env.localization.starts import Ballot, Start, start_at
from mmwave_env.logs.log import Log
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Index

DOUBTFUL_GAP_S = 10.0  # the first epochs after a gap of this length are doubted like a start


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
    gap_s = _gaps(log)
    ends = _ends(log, gap_s)
    links = log.visible[:, : log.layout.anchors].any(axis=1)
    doubtful = np.flatnonzero((gap_s > DOUBTFUL_GAP_S) & links)
    parts: list[Segment] = []
    first = 0
    while first < len(log):
        end = int(ends[np.searchsorted(ends, first, side="right")])
        parts.extend(_divided(log, first, end, doubtful, scene, radio))
        first = end
    if not parts:
        raise log.damage or ValueError(
            f"log: found {len(log)} epochs, none of which determines a position, expected links "
            "that together determine a single position, with ranges, azimuths or both; without "
            "azimuths, anchors on a line leave two positions, between which side in the scene, or "
            "--start, decides"
        )
    return parts


def stretches(log: Log, scene: Scene, radio: Radio) -> Iterator[Segment]:
    """Yield the epochs between long gaps, from the first on that determines a position.

    Other than :func:`segments`, these may contain epochs that contradict a start.
    """
    first = 0
    for end in _ends(log, _gaps(log)).tolist():
        begin, start = _begun(log, first, end, scene, radio)
        if start:
            yield Segment(slice(begin, end), start)
        first = end


def _ends(log: Log, gap_s: Index) -> Index:
    """Return the indices at which parts end, because of long gaps or of ``restarts``."""
    return np.append(np.flatnonzero((gap_s > GAP_S) | log.restarts), len(log))


def _divided(
    log: Log, first: int, end: int, doubtful: Index, scene: Scene, radio: Radio
) -> Iterator[Segment]:
    """Yield the segments of epochs without a long gap."""
    while first < end:
        begin, start = _begun(log, first, end, scene, radio)
        if start is None:
            return
        ballot = _ballot(log, begin, end, scene, radio)
        start = ballot.start(log, begin) or start
        cut = ballot.jump()
        for gap in doubtful[(doubtful > begin) & (doubtful < end)].tolist():
            if cut is not None and cut <= gap:
                break
            ballot = _ballot(log, gap, end, scene, radio)
            later = gap if ballot.start(log, gap) else ballot.jump()
            cut = later if cut is None else cut
        first = end if cut is None else cut
        yield Segment(slice(begin, first), start)


def _begun(log: Log, first: int, end: int, scene: Scene, radio: Radio) -> tuple[int, Start | None]:
    """Return the first epoch that determines a position, and the start there; else end, None."""
    visible = log.visible[first:end, : log.layout.anchors].any(axis=1)
    for epoch in (np.flatnonzero(visible) + first).tolist():
        start = start_at(log, epoch, scene, radio)
        if start:
            return epoch, start
    return end, None


def _ballot(log: Log, first: int, end: int, scene: Scene, radio: Radio) -> Ballot:
    """Return the votes of the epochs from ``first`` on, before ``end``."""
    ballot = Ballot(scene, radio)
    for epoch in range(first, end):
        if not ballot.is_open(float(log.time_s[epoch] - log.time_s[first])):
            break
        ballot.add(log, epoch)
    return ballot


def _gaps(log: Log) -> Index:
    """Return how long (T,), s, before each epoch the last link or odometry was measured."""
    measured = log.visible[:, : log.layout.anchors].any(axis=1)
    if log.layout.odometry:  # with odometry alone, a filter keeps the track for two minutes
        measured |= log.visible[:, -1]
    latest = np.maximum.accumulate(np.where(measured, log.time_s, -np.inf))
    return np.append(0.0, log.time_s[1:] - latest[:-1])
