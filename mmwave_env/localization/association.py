"""Association of propagation paths with anchors, for logs without anchor numbers.

The anchors are the base station and its mirror images. A track begins with the hypothesis that a
certain path is the line of sight. This path determines a position, and the paths of the next epochs
confirm or contradict the hypothesis: it begins a track if this track would explain (assign to
anchors) enough of them. A track ends after a long gap, or when a new track that explains clearly
more paths replaces it. Tracks are immutable, so several can be tried side by side.

In every epoch, an EKF (:mod:`mmwave_env.localization.image_filter`, with images that are exactly
known) predicts the user's state. Given this state, paths are assigned to anchors by global nearest
neighbor (Blackman and Popoli 1999, Sec. 6.4). Each path and each anchor is used at most once. A
path may belong to an anchor only if the pair's NIS is below a limit, the gate. The assignment with
the smallest sum of NIS is chosen; an anchor without a path adds the gate to this sum. The result is
an ordinary log, in which every measurement belongs to a known anchor.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.modes import Mode
from mmwave_env.io.files import Json
from mmwave_env.localization.first_position import HEIGHT_SIGMA_M
from mmwave_env.localization.image_filter import (
    LINK_ROWS,
    UNKNOWN_RAD,
    Belief,
    Image,
    ImageFilter,
    Paths,
)
from mmwave_env.localization.starts import gives_fix
from mmwave_env.logs.log import Log, PathEpoch, PathLog
from mmwave_env.models.layout import STATE_SIZE, Layout
from mmwave_env.models.measurement import link_group
from mmwave_env.models.prior import GAP_S, prior_from_fix
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask

LOOK_AHEAD = 10  # number of epochs whose paths decide whether a track begins in the first of them
GATE = float(chdtri(LINK_ROWS, 0.01))  # a path may belong to an anchor if its NIS is below
STRAIGHT = float(chdtri(1, 0.01))  # a path may be the line of sight if azimuths differ by less
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


def disagreement(paths: Array, sigma: Array) -> Array:
    """Compute the NIS (n,) of the difference between the two azimuths of paths (n, 4).

    The NIS has 1 degree of freedom. The user's position is not needed, because the azimuths of
    arrival and departure measure the same bearing (paper, Sec. II-B).
    """
    # The user is placed in the direction of arrival, so the arrival's residual is 0 and can't wrap.
    user = [np.cos(paths[:, 1]), np.sin(paths[:, 1]), 1.0, *[0.0] * 4]
    group = link_group(user, [0.0] * 3, list(paths.T), list(np.square(sigma).T))
    return np.asarray(group.spare_nis)


def observed(
    epochs: Iterable[PathEpoch], at_station: bool, scene: Scene, radio: Radio, straight: float
) -> Iterator[Paths]:
    """Yield the paths of each epoch, with the receiver's variances, else those at their SNR.

    ``at_station`` is as in :class:`~mmwave_env.logs.log.PathLog`. The azimuths of a line of sight
    have a :func:`disagreement` below ``straight``.
    """
    links = replace(scene, range_offset_m=(), range_offset_sigma_m=())
    for epoch in epochs:
        z = epoch.links[0]
        snr_db = np.column_stack([epoch.snr_db, epoch.snr_db])
        own = np.tile(np.minimum(epoch.sigma, UNKNOWN_RAD) ** 2, 2)
        variance = radio.sigma(snr_db, links, Layout(2)) ** 2
        stated = np.isfinite(own)
        variance[:, : 2 * LINK_ROWS][stated] = own[stated]
        variance[:, [0, LINK_ROWS]] += scene.offset_sigmas_m.max() ** 2
        direct, reflected, doppler = np.split(variance, [LINK_ROWS, 2 * LINK_ROWS], axis=1)
        opposite = gives_fix(z) & (disagreement(z, np.sqrt(direct)) < straight)
        yield Paths(
            epoch.time_s, z, epoch.doppler, direct, reflected, doppler[:, 0], opposite, at_station
        )


def fix_of(paths: Paths, path: int, radio: Radio, scene: Scene) -> tuple[Array, Array]:
    """Return the prior, mean and covariance, of a user whose line of sight is a path.

    If the path has no elevation, the height of the streets is known roughly.
    """
    sigma = np.sqrt(paths.direct[path])
    if sigma[2] >= UNKNOWN_RAD:
        sigma[2] = HEIGHT_SIGMA_M / paths.z[path, 0]
    return prior_from_fix(np.array(scene.base_station_m), paths.z[path], sigma, radio, scene)


class PathTracker:
    """A tracker that follows users by propagation paths; :func:`associate` names its arguments."""

    def __init__(self, scene: Scene, radio: Radio, mode: Mode) -> None:
        self._scene = scene
        self._radio = radio
        self._anchors = scene.anchors_m
        self._filter = ImageFilter(self._anchors[0], scene.hz_per_mps, mode.tuning, scene.offsets_m)

    def tracks(self, log: PathLog) -> tuple[list[Belief | None], list[bool]]:
        """Return every epoch's track (None if there is none), and whether it begins there."""
        radio = self._radio
        epochs = [*observed(log.epochs, log.at_station, self._scene, radio, STRAIGHT)]
        track: Belief | None = None
        seen_s = -np.inf
        tracks: list[Belief | None] = []
        restarts: list[bool] = []
        for number, paths in enumerate(epochs):
            if paths.time_s - seen_s > GAP_S:
                track = None
            track = track and self.follow(track, paths)
            rival = self.rival(track, epochs[number : number + LOOK_AHEAD])
            track = rival or track
            if track and (track.labels or _has_odometry(log.epochs[number], log.layout)):
                seen_s = paths.time_s
            tracks.append(track)
            restarts.append(rival is not None)
        return tracks, restarts

    def follow(self, track: Belief, paths: Paths) -> Belief:
        """Return the track after the next epoch."""
        track = self._filter.predicted(track, paths.time_s)
        nis, _ = self._filter.nis(track, paths)
        labels = assign(nis, GATE)
        return self._filter.updated(track, paths, labels, nis)._replace(labels=labels)

    def rival(self, track: Belief | None, window: Sequence[Paths]) -> Belief | None:
        """Return a track that begins in ``window[0]`` and explains more paths than ``track``.

        The result is None if there is no such track, or if a track that begins in a later epoch of
        the window explains even more paths. Without this second condition, a track might begin
        during a blockage, from a reflection that is mistaken for the line of sight.
        """
        horizon = window[0].time_s + GAP_S
        coming = [epoch for epoch in window[1:] if epoch.time_s <= horizon]
        best, fitted = self._best(track, window[0], coming)
        if best is None:
            return None
        # The new track must explain at least one path per coming epoch, and clearly more paths than
        # ``track``. A new track does not know the velocity, so its gates are wide, and wrong paths
        # may fit. The path from which it begins always fits, so this path does not count.
        own = 0.0 if track is None else self._fitted(track, coming) + CLEARLY_MORE * len(coming)
        if fitted - 1 < max(own, len(coming)):
            return None
        later = (self._best(None, epoch, coming[k + 1 :])[1] for k, epoch in enumerate(coming))
        return best if fitted >= max(later, default=0) else None

    def _best(
        self, track: Belief | None, paths: Paths, coming: Sequence[Paths]
    ) -> tuple[Belief | None, int]:
        """Return the best track that begins in this epoch, and how many paths it explains."""
        begun = ((new, self._fitted(new, coming)) for new in self._beginnings(track, paths))
        return max(begun, key=lambda pair: pair[1], default=(None, 0))

    def _fitted(self, track: Belief, coming: Sequence[Paths]) -> int:
        """Count the paths that a track explains in its epoch and in coming epochs."""
        fitted = len(track.labels)
        for paths in coming:
            track = self.follow(track, paths)
            fitted += len(track.labels)
        return fitted

    def _beginnings(self, track: Belief | None, paths: Paths) -> Iterator[Belief]:
        """Yield a track for each path that may be the line of sight, except paths of ``track``."""
        likely = paths.straight.copy()
        if track:
            likely[list(track.labels.values())] = False
            if 0 in track.labels:  # no path is shorter than the line of sight
                likely &= paths.z[:, 0] < paths.z[track.labels[0], 0]
        for path in np.flatnonzero(likely).tolist():
            begun = self._begin(paths, path)
            if begun:
                yield begun

    def _begin(self, paths: Paths, path: int) -> Belief | None:
        """Return a track with this path as line of sight; None if a wall would block this path."""
        anchors = self._anchors
        mean, covariance = fix_of(paths, path, self._radio, self._scene)
        distance = np.linalg.norm(mean[:3] - anchors, axis=1)
        if distance.argmin() != 0:  # a position behind a wall is nearest to a mirror image
            return None
        images = anchors[1:]
        P = np.zeros((STATE_SIZE + images.size,) * 2)
        P[:STATE_SIZE, :STATE_SIZE] = covariance
        exact = (Image(exact=True),) * len(images)
        track = Belief(np.append(mean, images), P, exact, paths.time_s)
        nis, _ = self._filter.nis(track, paths)
        others = nis.copy()
        others[0] = np.inf
        others[:, path] = np.inf
        labels = assign(others, GATE)
        track = self._filter.updated(track, paths, labels, nis)
        return track._replace(labels={**labels, 0: path})


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
    layout = paths.layout
    epochs = paths.epochs
    anchors = layout.anchors
    z = np.full((len(epochs), layout.size), np.nan)
    sigma = np.full(z.shape, np.nan)
    visible = np.zeros((len(epochs), len(layout.groups)), np.bool_)
    snr_db = np.full((len(epochs), anchors), -np.inf)
    tracks, restarts = PathTracker(scene, radio, mode).tracks(paths)
    for t, (track, epoch) in enumerate(zip(tracks, epochs, strict=True)):
        labels = track.labels if track else {}
        for anchor, path in labels.items():
            own = epoch.sigma[path]
            z[t, layout.link(anchor)] = np.where(np.isinf(own), np.nan, epoch.links[anchor, path])
            sigma[t, layout.link(anchor)] = np.where(np.isinf(own), np.nan, own)
            snr_db[t, anchor] = np.nan_to_num(epoch.snr_db[path], nan=-np.inf)
            visible[t, anchor] = True
        if 0 in labels and np.isfinite(doppler := epoch.doppler[labels[0]]):
            z[t, layout.doppler] = doppler
            visible[t, anchors] = True
        if _has_odometry(epoch, layout):
            z[t, layout.doppler + 1 :] = epoch.odometry
            visible[t, -1] = True
    log = Log(
        layout=layout,
        time_s=np.array([epoch.time_s for epoch in epochs]),
        measurement=z,
        sigma=sigma,
        visible=visible,
        incomplete=np.zeros_like(visible),
        doppler_anchor=np.zeros(len(epochs), np.int64),
        snr_db=snr_db,
        doppler_spread_hz=np.array([epoch.doppler_spread_hz for epoch in epochs]),
        line=np.array([epoch.line for epoch in epochs]),
        restarts=np.array(restarts),
        damage=paths.damage,
    )
    tracked = np.array([track is not None for track in tracks])
    return log, _counts(log, epochs, tracked)


def _has_odometry(epoch: PathEpoch, layout: Layout) -> bool:
    return layout.odometry and bool(np.isfinite(epoch.odometry).all())


def _counts(log: Log, epochs: Sequence[PathEpoch], tracked: Mask) -> Json:
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
