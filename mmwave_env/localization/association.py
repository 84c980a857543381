"""Association of propagation paths with anchors, for logs without anchor numbers.

A filter (``path_tracker.py``) follows the user and predicts the user's state in every epoch. Given
this state, the method of the global nearest neighbor assigns the paths to anchors. The result is an
ordinary log, in which every measurement belongs to a known anchor.

A path that may be the line of sight begins a track if this track would explain (assign to anchors)
enough paths of the coming epochs. A track ends after a long gap, or when a new track that explains
clearly more paths replaces it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mmwave_env.filters.modes import Mode
from mmwave_env.localization.path_tracker import PathTrack, PathTracker
from mmwave_env.logs.log import Log, PathEpoch, PathLog
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Mask

LOOK_AHEAD = 10  # number of epochs whose paths decide whether a track begins in the first of them


def associate(paths: PathLog, scene: Scene, radio: Radio, mode: Mode) -> tuple[Log, dict[str, Any]]:
    """Associate the paths of a log with anchors; an epoch without a track gets no paths.

    Args:
        paths: the log of paths.
        scene: scene whose anchors were measured.
        radio: profile of the receiver; it determines the noise at each SNR, and the prior.
        mode: filter mode that follows the user during association. Choose a mode for high mobility:
            the gates around its uncertain predictions are wide enough for any user.

    Returns:
        The resulting log, whose ``damage`` is an error if it ends before measurements that no
        receiver can make; and the counts of associated, false and missed paths.

    Raises:
        LogError: there are such measurements in the first epoch.
    """
    layout = paths.epochs[0].layout
    tracker = PathTracker(scene, radio, mode, layout)
    tracks, restarts, damage = _follow(paths, tracker)
    epochs = paths.epochs[: len(tracks)]
    labelled = [
        track.epoch if track else tracker.nothing(epoch)
        for track, epoch in zip(tracks, epochs, strict=True)
    ]
    visible = np.array([epoch.visible for epoch in labelled]) > 0.5
    snr_db = np.array([epoch.snr_db for epoch in labelled])
    log = Log(
        layout=layout,
        time_s=np.array([epoch.time_s for epoch in epochs]),
        measurement=np.array([epoch.z for epoch in labelled]),
        sigma=np.full((len(epochs), layout.size), np.nan),
        visible=visible,
        incomplete=np.zeros_like(visible),
        doppler_anchor=np.zeros(len(epochs), np.int64),
        snr_db=np.where(visible[:, : layout.anchors], snr_db, -np.inf),
        doppler_spread_hz=np.array([epoch.doppler_spread_hz for epoch in epochs]),
        line=np.array([epoch.line for epoch in epochs]),
        restarts=np.array(restarts),
        damage=damage,
    )
    tracked = np.array([track is not None for track in tracks])
    return log, _counts(log, epochs, tracked)


def _follow(
    paths: PathLog, tracker: PathTracker
) -> tuple[list[PathTrack | None], list[bool], LogError | None]:
    """Return every epoch's track (None if there is none), whether it begins there, and damage."""
    track: PathTrack | None = None
    tracks: list[PathTrack | None] = []
    restarts: list[bool] = []
    for number, epoch in enumerate(paths.epochs):
        if track and epoch.time_s - track.seen_s > GAP_S:
            track = None
        try:
            track = track and tracker.follow(track, epoch)
            rival = tracker.rival(track, paths.epochs[number : number + LOOK_AHEAD])
        except ArithmeticError as error:
            damage = LogError(
                f"log, line {epoch.line}, time {epoch.time_s} s: found measurements of a user "
                "straight above or below an anchor, or extremely far away, expected measurements "
                "that a receiver can make"
            )
            if not tracks:
                raise damage from error
            return tracks, restarts, damage
        track = rival or track
        tracks.append(track)
        restarts.append(rival is not None)
    return tracks, restarts, paths.damage


def _counts(log: Log, epochs: Sequence[PathEpoch], tracked: Mask) -> dict[str, Any]:
    """Count paths of an associated log, given its T epochs and which of them (T,) have a track.

    While a track exists, each path that is assigned to no anchor counts as a false path, and each
    anchor without a path in an epoch counts as a missed path.
    """
    paths = np.array([len(epoch.snr_db) for epoch in epochs])
    anchors = log.layout.anchors
    links = log.visible[tracked, :anchors]
    associated = links.sum(axis=0).tolist()
    missed = (~links).sum(axis=0).tolist()
    names = log.layout.group_names[:anchors]
    return {
        "paths": int(paths.sum()),
        "incomplete": sum(epoch.incomplete for epoch in epochs),
        "associated": dict(zip(names, associated, strict=True)),
        "missed": dict(zip(names, missed, strict=True)),
        "false": int(paths[tracked].sum()) - sum(associated),
        "without_track": {"epochs": int((~tracked).sum()), "paths": int(paths[~tracked].sum())},
        "starts": int(log.restarts.sum()),
    }
