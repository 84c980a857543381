"""Association of propagation paths with anchors, for logs without anchor numbers.

A filter (``path_tracker.py``) follows the user and predicts the user's state in every epoch. Given
this state, the method of the global nearest neighbor assigns the paths to anchors. The result is an
ordinary log, in which every measurement belongs to a known anchor.

A path that may be the line of sight begins a track if this track would explain (assign to anchors)
enough paths of the coming epochs. A track ends after a long gap, or when a new track that explains
clearly more paths replaces it.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from mmwave_env.filters.modes import Mode
from mmwave_env.localization.path_tracker import NO_PATH, PathTrack, PathTracker
from mmwave_env.logs.log import LogBlock, PathEpoch, in_windows
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.measurement import Epoch
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Index

LOOK_AHEAD = 10  # number of epochs whose paths decide whether a track begins in the first of them


class Association:
    """Counts of the associated, false and missed paths of a log.

    While a track exists, each path that is assigned to no anchor counts as a false path, and each
    anchor without a path in an epoch counts as a missed path.
    """

    def __init__(self, anchors: int) -> None:
        self.epochs = self.untracked_epochs = self.starts = 0
        self._paths = self._incomplete = self._untracked = 0
        self._associated, self._missed = np.zeros((2, anchors), np.int64)

    def add(self, paths: PathEpoch, labels: Index | None, begins: bool) -> None:
        """Add an epoch, with the ``labels`` of its :class:`PathTrack`; None if no track exists."""
        self.epochs += 1
        self.starts += begins
        self._paths += len(paths.snr_db)
        self._incomplete += paths.incomplete
        if labels is None:
            self.untracked_epochs += 1
            self._untracked += len(paths.snr_db)
            return
        self._associated += labels != NO_PATH
        self._missed += labels == NO_PATH

    def figures(self) -> dict[str, Any]:
        """Return the counts as a dictionary."""
        named = [f"anchor {a + 1}" for a in range(len(self._missed))]
        return {
            "paths": self._paths,
            "incomplete": self._incomplete,
            "associated": dict(zip(named, self._associated.tolist(), strict=True)),
            "missed": dict(zip(named, self._missed.tolist(), strict=True)),
            "false": self._paths - self._untracked - int(self._associated.sum()),
            "without_track": {"epochs": self.untracked_epochs, "paths": self._untracked},
            "starts": self.starts,
        }


def associate(
    epochs: Iterable[PathEpoch],
    scene: Scene,
    radio: Radio,
    mode: Mode,
    tally: Association,
    epochs_per_block: int = 4096,
) -> Iterator[LogBlock]:
    """Associate the paths of a log with anchors, and yield the resulting log in blocks of epochs.

    If the log is damaged, the epochs before the damage are yielded before the error is raised.

    Args:
        epochs: epochs of the log of paths.
        scene: scene whose anchors were measured.
        radio: profile of the receiver; it determines the noise at each SNR, and the prior.
        mode: filter mode that follows the user during association. Choose a mode for high mobility:
            the gates around its uncertain predictions are wide enough for any user.
        tally: counts to which each epoch is added.

    Raises:
        LogError: the log is damaged, or contains measurements that no receiver can have made.
    """
    return in_windows(_labelled(epochs, scene, radio, mode, tally), epochs_per_block)


def _labelled(
    epochs: Iterable[PathEpoch], scene: Scene, radio: Radio, mode: Mode, tally: Association
) -> Iterator[LogBlock]:
    """Yield every epoch with its paths assigned to anchors, or without paths if no track exists."""
    track: PathTrack | None = None
    tracker: PathTracker | None = None
    for window in _windows(epochs, LOOK_AHEAD):
        paths = window[0]
        tracker = tracker or PathTracker(scene, radio, mode, paths.layout)
        if track and paths.time_s - track.seen_s > GAP_S:
            track = None
        try:
            track = track and tracker.follow(track, paths)
            rival = tracker.rival(track, window)
        except ArithmeticError as error:
            raise LogError(
                f"log, time {paths.time_s} s: found measurements of a user straight above or below "
                "an anchor, or extremely far away, expected measurements that a receiver can make"
            ) from error
        track = rival or track
        tally.add(paths, track and track.labels, rival is not None)
        yield _block(paths, track.epoch if track else tracker.nothing(paths), rival is not None)


def _block(paths: PathEpoch, epoch: Epoch, begins: bool) -> LogBlock:
    """Return an associated epoch as a block of a log; ``begins``: whether a track begins here."""
    visible = np.array([epoch.visible]) > 0.5
    return LogBlock(
        layout=paths.layout,
        time_s=np.array([paths.time_s]),
        measurement=np.array([epoch.z]),
        sigma=np.full((1, paths.layout.size), np.nan),
        visible=visible,
        incomplete=np.zeros_like(visible),
        doppler_anchor=np.zeros(1, np.int64),
        snr_db=np.where(visible[:, : paths.layout.anchors], [epoch.snr_db], -np.inf),
        doppler_spread_hz=np.array([paths.doppler_spread_hz]),
        restarts=np.array([begins]),
        share=paths.share,
    )


def _windows(epochs: Iterable[PathEpoch], size: int) -> Iterator[list[PathEpoch]]:
    """Yield, for each epoch, the list of ``size`` epochs (fewer at the end) that begins there."""
    held: list[PathEpoch] = []
    try:
        for epoch in epochs:
            held.append(epoch)
            if len(held) == size:
                yield held
                held = held[1:]
    except LogError:
        yield from (held[first:] for first in range(len(held)))
        raise
    yield from (held[first:] for first in range(len(held)))
