"""Association of propagation paths with anchors, for logs without anchor numbers.

The anchors are the base station and its mirror images. A track begins with the hypothesis that a
certain path is the line of sight, or comes from a certain image. This path determines a position,
and the paths of the next epochs confirm or contradict the hypothesis: it begins a track if this
track would explain (assign to anchors) enough of them. A track ends after a long gap, or when a new
track that explains clearly more paths replaces it. Tracks are immutable, so several can be tried
side by side.

In every epoch, an EKF (:mod:`mmwave_env.localization.image_filter`, with images that are exactly
known) predicts the user's state. Given this state, paths are assigned to anchors by global nearest
neighbor (Blackman and Popoli 1999, Sec. 6.4). Each path and each anchor is used at most once. A
path may belong to an anchor only if the pair's NIS is below a limit, the gate. The assignment with
the smallest sum of NIS is chosen; an anchor without a path adds the gate to this sum. The result is
an ordinary log, in which every measurement belongs to a known anchor.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.modes import Mode
from mmwave_env.io.files import Json
from mmwave_env.localization.image_filter import LINK_ROWS, USER, Belief, ImageFilter, Paths
from mmwave_env.logs.log import Log, PathLog, log_of
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask

LOOK_AHEAD = 10  # number of epochs whose paths decide whether a track begins in the first of them
GATE = float(chdtri(LINK_ROWS, 0.01))  # a path may belong to an anchor if its NIS is below
# An association is doubtful if more of the paths are false, and some anchor lacks paths more often.
# With a right map, either few paths are false or all anchors are seen often.
MOST_FALSE = 0.4
MOST_MISSED = 0.6
CLEARLY_MORE = 0.5  # additional paths per epoch that a new track must explain to replace another


def assign(cost: Array, gate: float) -> dict[int, int]:
    """Return the path of each anchor that has one, so that the sum of costs is least.

    ``cost`` (A, n) is, for example, the NIS; a path may belong to an anchor only if its cost is
    below ``gate``.
    """
    from scipy.optimize import linear_sum_assignment

    # A pair outside the gate costs as much as an anchor without a path. It is discarded below.
    pairs = linear_sum_assignment(np.minimum(np.nan_to_num(cost, nan=np.inf), gate))
    return {int(a): int(i) for a, i in zip(*pairs, strict=True) if cost[a, i] < gate}


class PathTracker(ImageFilter):
    """A tracker that follows users by propagation paths; :func:`associate` names its arguments."""

    def tracks(self, log: PathLog) -> list[Belief]:
        """Return every epoch's track; one that is not ``tracked`` means that there is none."""
        epochs = [*self.observed(log)]
        table = log.table
        speed = table.first(table["speed"])
        heading = table.first(table["heading"])
        moved = np.isfinite(speed) & np.isfinite(heading)
        track = self.start
        seen_s = -np.inf
        tracks = []
        for number, paths in enumerate(epochs):
            if paths.time_s - seen_s > GAP_S:
                track = self.start
            if track.tracked:
                track = self.step(track, paths)
            track = self.chosen(track, epochs[number : number + LOOK_AHEAD])
            if track.labels or (track.tracked and moved[number]):
                seen_s = paths.time_s
            tracks.append(track)
        return tracks

    def step(self, b: Belief, paths: Paths, sight_used: bool = False) -> Belief:
        """Return the track after the next epoch, as :meth:`ImageFilter.step` says."""
        b = self.predicted(b, paths.time_s)
        nis, _ = self.nis(b, paths)
        if sight_used:
            nis[0] = np.inf
        labels = assign(nis, GATE)
        return self.updated(b, paths, labels, nis)._replace(labels=labels)

    def chosen(self, track: Belief, window: Sequence[Paths]) -> Belief:
        """Return a track that begins in ``window[0]`` and explains more paths, else ``track``.

        A new track is not chosen if one that begins in a later epoch of the window explains even
        more paths. Without this second condition, a track might begin during a blockage, from a
        reflection that is mistaken for the line of sight.
        """
        horizon = window[0].time_s + GAP_S
        coming = [epoch for epoch in window[1:] if epoch.time_s <= horizon]
        best, fitted = self._best(track, window[0], coming)
        # The new track must explain at least one path per coming epoch, and clearly more paths than
        # ``track``. A new track does not know the velocity, so its gates are wide, and wrong paths
        # may fit. The path from which it begins always fits, so this path does not count.
        if fitted - 1 < len(coming):
            return track
        if track.tracked:
            own = self._fitted(track, coming) + CLEARLY_MORE * len(coming)
            if fitted - 1 < own:
                return track
        later = (
            self._best(self.start, epoch, coming[k + 1 :])[1] for k, epoch in enumerate(coming)
        )
        return best if fitted >= max(later, default=0) else track

    def _best(self, track: Belief, paths: Paths, coming: Sequence[Paths]) -> tuple[Belief, int]:
        """Return the best track that begins in this epoch, and how many paths it explains.

        If a track begins at an image, the line of sight is blocked, so its paths do not count.
        """
        begun = (
            (new, self._fitted(new, coming, 0 not in new.labels))
            for new in self._beginnings(track, paths)
        )
        return max(begun, key=lambda pair: pair[1], default=(track, 0))

    def _fitted(self, track: Belief, coming: Sequence[Paths], blocked: bool = False) -> int:
        """Count the paths that a track explains in its epoch and in coming epochs."""
        return len(track.labels) + self.ahead(track, coming, blocked)[1]

    def _beginnings(self, track: Belief, paths: Paths) -> Iterator[Belief]:
        """Yield a track for each path that may be the line of sight, except paths of ``track``."""
        likely = paths.straight.copy()
        likely[list(track.labels.values())] = False
        if 0 in track.labels:  # no path is shorter than the line of sight
            likely &= paths.z[:, 0] < paths.z[track.labels[0], 0]
        places = self._scene.anchors_m
        # without a line of sight, a path from an image may explain more
        several = track.tracked or paths.at_station
        for anchor in range(1 if several else len(places)):
            for path in np.flatnonzero(likely).tolist():
                prior = self.prior(self.start, paths, path, anchor)
                # a position behind a wall is nearest to another anchor than the base station
                if np.linalg.norm(prior.x[USER] - places, axis=1).argmin() == 0:
                    yield self.begun(prior, paths, path, anchor)


def associate(paths: PathLog, scene: Scene, radio: Radio, mode: Mode) -> tuple[Log, Json]:
    """Associate the paths of a log with anchors; an epoch without a track gets no paths.

    Args:
        paths: the log of paths.
        scene: scene whose anchors were measured.
        radio: profile of the receiver; it determines the noise at each SNR, and the prior.
        mode: filter mode whose process noise is used. Choose a mode for high mobility: the gates
            around its uncertain predictions are wide enough for any user.

    Returns:
        The resulting log; and the counts of associated, false and missed paths.
    """
    known = replace(scene, learned=())  # learned images count as exactly known
    tracks = PathTracker(known, radio, mode).tracks(paths)
    anchor = np.full(len(paths.table), np.nan)
    for track, rows in zip(tracks, paths.epochs, strict=True):
        for number, path in track.labels.items():
            anchor[rows[path]] = number + 1
    log = log_of(paths.table, number=anchor)
    if not paths.layout.partial:
        log = log.whole()
    begins = np.array([track.begins for track in tracks])
    log = replace(log, restarts=begins, damage=paths.damage)
    return log, _counts(log, paths, np.array([track.tracked for track in tracks]))


def _counts(log: Log, path_log: PathLog, tracked: Mask) -> Json:
    """Count the paths of an associated log, given which of its T epochs (T,) have a track.

    While a track exists, each path that is assigned to no anchor counts as a false path, and each
    anchor without a path in an epoch counts as a missed path.
    """
    paths = np.array([len(rows) for rows in path_log.epochs])
    counts = log.visible_links.sum(axis=0).tolist()
    associated = dict(zip(log.layout.group_names, counts, strict=False))
    without = {"epochs": int((~tracked).sum()), "paths": int(paths[~tracked].sum())}
    return {
        "paths": int(paths.sum()),
        "incomplete": path_log.incomplete,
        "associated": associated,
        "missed": {name: int(tracked.sum()) - count for name, count in associated.items()},
        "false": int(paths[tracked].sum()) - sum(counts),
        "without_track": without,
        "starts": int(log.restarts.sum()),
    }
