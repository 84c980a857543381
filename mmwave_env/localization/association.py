"""Association of propagation paths with anchors, for logs without anchor numbers.

A filter (``path_tracker.py``) follows the user and predicts the user's state in every epoch. Given
this state, the method of the global nearest neighbor assigns the paths to anchors. The result is an
ordinary log, in which every measurement belongs to a known anchor.

A path that may be the line of sight begins a track if this track would explain (assign to anchors)
enough paths of the coming epochs. A track ends after a long gap, or when a new track that explains
clearly more paths replaces it.
"""

from typing import Any

import numpy as np

from mmwave_env.filters.modes import Mode
from mmwave_env.localization.path_tracker import NO_PATH, PathTrack, PathTracker
from mmwave_env.logs.log import Log, PathEpoch, PathLog
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


def associate(paths: PathLog, scene: Scene, radio: Radio, mode: Mode, tally: Association) -> Log:
    """Associate the paths of a log with anchors; return the resulting log.

    An epoch without a track has no paths.

    Args:
        paths: the log of paths.
        scene: scene whose anchors were measured.
        radio: profile of the receiver; it determines the noise at each SNR, and the prior.
        mode: filter mode that follows the user during association. Choose a mode for high mobility:
            the gates around its uncertain predictions are wide enough for any user.
        tally: counts to which each epoch is added.

    Returns:
        The log; ``damage`` is an error if it ends before measurements that no receiver can make.

    Raises:
        LogError: there are such measurements in the first epoch.
    """
    layout = paths.epochs[0].layout
    tracker = PathTracker(scene, radio, mode, layout)
    track: PathTrack | None = None
    labelled: list[Epoch] = []
    restarts: list[bool] = []
    damage = paths.damage
    for number, epoch in enumerate(paths.epochs):
        if track and epoch.time_s - track.seen_s > GAP_S:
            track = None
        try:
            track = track and tracker.follow(track, epoch)
            rival = tracker.rival(track, paths.epochs[number : number + LOOK_AHEAD])
        except ArithmeticError:
            damage = LogError(
                f"log, time {epoch.time_s} s: found measurements of a user straight above or below "
                "an anchor, or extremely far away, expected measurements that a receiver can make"
            )
            break
        track = rival or track
        tally.add(epoch, track and track.labels, rival is not None)
        labelled.append(track.epoch if track else tracker.nothing(epoch))
        restarts.append(rival is not None)
    if damage and not labelled:
        raise damage
    kept = paths.epochs[: len(labelled)]
    visible = np.array([epoch.visible for epoch in labelled]) > 0.5
    snr_db = np.array([epoch.snr_db for epoch in labelled])
    return Log(
        layout=layout,
        time_s=np.array([epoch.time_s for epoch in kept]),
        measurement=np.array([epoch.z for epoch in labelled]),
        sigma=np.full((len(kept), layout.size), np.nan),
        visible=visible,
        incomplete=np.zeros_like(visible),
        doppler_anchor=np.zeros(len(kept), np.int64),
        snr_db=np.where(visible[:, : layout.anchors], snr_db, -np.inf),
        doppler_spread_hz=np.array([epoch.doppler_spread_hz for epoch in kept]),
        line=np.array([epoch.line for epoch in kept]),
        restarts=np.array(restarts),
        damage=damage,
    )
