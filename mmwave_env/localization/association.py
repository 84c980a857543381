"""Association of propagation paths with anchors, for logs without anchor numbers.

The anchors are the base station and its mirror images. A track begins with the hypothesis that a
certain path is the line of sight. This path determines a position, and the paths of the next epochs
confirm or contradict the hypothesis: it begins a track if this track would explain (assign to
anchors) enough of them. A track ends after a long gap, or when a new track that explains clearly
more paths replaces it. Tracks are immutable, so several can be tried side by side.

In every epoch, a filter predicts the user's state. Given this state, paths are assigned to anchors
by global nearest neighbor (Blackman and Popoli 1999, Sec. 6.4). Each path and each anchor is used
at most once. A path may belong to an anchor only if the pair's NIS is below a limit, the gate. The
assignment with the smallest sum of NIS is chosen; an anchor without a path adds the gate to this
sum. An EKF, linearized at the prediction, computes the NIS. The result is an ordinary log, in which
every measurement belongs to a known anchor.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.gating import innovation_statistics
from mmwave_env.filters.linearization import Tangent
from mmwave_env.filters.memory import Memory, initial_memory, memory_after, memory_before
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, predict, predict_update
from mmwave_env.localization.starts import gives_fix
from mmwave_env.logs.log import Log, PathEpoch, PathLog
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.measurement import Epoch, Site, link_group
from mmwave_env.models.prior import GAP_S, prior_from_fix
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.linalg import cholesky, pack
from mmwave_env.numerics.numbers import Array, Index, Mask, Matrix, Vector

NO_PATH = -1
LOOK_AHEAD = 10  # number of epochs whose paths decide whether a track begins in the first of them
GATE_QUANTILE = 0.99  # a path may belong to an anchor if its NIS is below this chi-square quantile
CLEARLY_MORE = 0.5  # additional paths per epoch that a new track must explain to replace another


def path_nis(x: Vector, P: Matrix, anchors: Matrix, paths: Array, sigma: Array) -> Array:
    """Compute the NIS (L, n) of each pair of an anchor and a path, given x (7,) and P (7, 7).

    ``paths`` (L, n, 4) contains the four values of a link (m and rad) that each anchor would have
    measured if the path belonged to it. ``sigma`` contains their standard deviations.
    """
    tangent = Tangent()
    L = cholesky(P)
    latents = tangent.latents(0)
    nis = np.empty(paths.shape[:2])
    for row, anchor, z, deviations in zip(nis, anchors, paths, sigma, strict=True):
        group = link_group(x, anchor, list(z.T), list(np.square(deviations).T))
        row[:], _ = innovation_statistics(group, tangent.rows(group, L, latents), latents)
    return nis


def assign(cost: Array, gate: float) -> Index:
    """Return the indices (L,) of the anchors' paths; ``NO_PATH`` for an anchor without a path.

    ``cost`` (L, n) is, for example, the NIS; a path may belong to an anchor only if its cost is
    below ``gate``.
    """
    from scipy.optimize import linear_sum_assignment

    labels = np.full(len(cost), NO_PATH)
    # A pair outside the gate costs as much as an anchor without a path. It is discarded below.
    anchors, paths = linear_sum_assignment(np.minimum(np.nan_to_num(cost, nan=np.inf), gate))
    inside = cost[anchors, paths] < gate
    labels[anchors[inside]] = paths[inside]
    return labels


def disagreement(paths: Array, sigma: Array) -> Array:
    """Compute the NIS (n,) of the difference between the two azimuths of paths (n, 4).

    The NIS has 1 degree of freedom. The user's position is not needed, because the azimuths of
    arrival and departure measure the same bearing (paper, Sec. II-B).
    """
    # The user is placed in the direction of arrival, so the arrival's residual is 0 and can't wrap.
    user = [np.cos(paths[:, 1]), np.sin(paths[:, 1]), 1.0, *[0.0] * 4]
    group = link_group(user, [0.0] * 3, list(paths.T), list(np.square(sigma).T))
    return np.asarray(group.spare_nis)


class PathTrack(NamedTuple):
    """A hypothesis about the user's state after an epoch."""

    x: list[float]  # (7,) mean
    P: list[float]  # (28,) packed covariance
    memory: Memory
    time_s: float
    seen_s: float  # last time at which the track used a path or odometry
    labels: Index  # (L,) index of every anchor's path in this epoch, or NO_PATH
    epoch: Epoch  # this epoch; each assigned path is the link to its anchor

    @property
    def fitted(self) -> int:
        """Return the number of paths that the track explains (assigns to anchors) in this epoch."""
        return int((self.labels != NO_PATH).sum())


class PathTracker:
    """A tracker that follows users by propagation paths; :func:`associate` names its arguments."""

    def __init__(self, paths: PathLog, scene: Scene, radio: Radio, mode: Mode) -> None:
        layout = paths.layout
        self._scene = scene
        self._radio = radio
        self._mode = mode
        self._layout = layout
        self._pipeline = Pipeline((mode,), layout)
        self._anchors = scene.anchors_m.tolist()
        self._memory = initial_memory(layout, 1)
        self._gate = float(chdtri(4, 1.0 - GATE_QUANTILE))
        self._disagreement = float(chdtri(1, 1.0 - GATE_QUANTILE))
        any_snr = np.zeros((1, layout.anchors))  # odometry's sigma does not depend on the SNR
        self._odometry_sigma = radio.sigma(any_snr, scene, layout)[0, layout.doppler + 1 :].tolist()

    def follow(self, track: PathTrack, paths: PathEpoch) -> PathTrack:
        """Return the track after the next epoch."""
        sigma = self._sigma(paths)
        dt = paths.time_s - track.time_s
        coming = self.epoch(paths, dt)
        hz_per_mps = self._scene.hz_per_mps
        gamma = track.memory.gamma
        x, P = predict(self._pipeline, self._mode, track.x, track.P, gamma, coming, hz_per_mps)
        labels = assign(self._nis(x, P, paths, sigma), self._gate)
        epoch = self.epoch(paths, dt, sigma, labels)
        return self._updated(track._replace(labels=labels, epoch=epoch), paths.time_s)

    def rival(self, track: PathTrack | None, window: Sequence[PathEpoch]) -> PathTrack | None:
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
        self, track: PathTrack | None, paths: PathEpoch, coming: Sequence[PathEpoch]
    ) -> tuple[PathTrack | None, int]:
        """Return the best track that begins in this epoch, and how many paths it explains."""
        begun = ((new, self._fitted(new, coming)) for new in self._beginnings(track, paths))
        return max(begun, key=lambda pair: pair[1], default=(None, 0))

    def _fitted(self, track: PathTrack, coming: Sequence[PathEpoch]) -> int:
        """Count the paths that a track explains in its epoch and in coming epochs."""
        fitted = track.fitted
        for paths in coming:
            track = self.follow(track, paths)
            fitted += track.fitted
        return fitted

    def _beginnings(self, track: PathTrack | None, paths: PathEpoch) -> Iterator[PathTrack]:
        """Yield a track for each path that may be the line of sight, except paths of ``track``."""
        sigma = self._sigma(paths)
        sights = paths.links[0]
        likely = gives_fix(sights) & (disagreement(sights, sigma[:, :4]) < self._disagreement)
        if track:
            likely[track.labels[track.labels != NO_PATH]] = False
            if track.labels[0] != NO_PATH:  # no path is shorter than the line of sight
                likely &= sights[:, 0] < sights[track.labels[0], 0]
        for path in np.flatnonzero(likely):
            begun = self._begin(paths, sigma, int(path))
            if begun:
                yield begun

    def _begin(self, paths: PathEpoch, sigma: Array, path: int) -> PathTrack | None:
        """Return a track with this path as line of sight; None if a wall would block this path."""
        anchors = self._scene.anchors_m
        mean, covariance = prior_from_fix(
            anchors[0], paths.links[0, path], sigma[path, :4], self._radio, self._scene
        )
        distance = np.linalg.norm(mean[:3] - anchors, axis=1)
        if distance.argmin() != 0:  # a position behind a wall is nearest to a mirror image
            return None
        x = mean.tolist()
        P = covariance.tolist()
        nis = self._nis(x, P, paths, sigma)
        nis[0] = np.inf
        nis[:, path] = np.inf
        labels = assign(nis, self._gate)
        epoch = self.epoch(paths, 0.0, sigma, labels)
        prior = PathTrack(x, pack(P), self._memory, paths.time_s, paths.time_s, labels, epoch)
        track = self._updated(prior, paths.time_s)
        labels[0] = path
        return track._replace(epoch=self.epoch(paths, 0.0, sigma, labels))

    def _sigma(self, paths: PathEpoch) -> Array:
        """Return standard deviations (n, rows) of all values, if all anchors had a path's SNR."""
        snr_db = np.repeat(paths.snr_db[:, None], self._layout.anchors, axis=1)
        return self._radio.sigma(snr_db, self._scene, self._layout)

    def _nis(self, x: Vector, P: Matrix, paths: PathEpoch, sigma: Array) -> Array:
        """Return the NIS (L, n) of each pair of an anchor and a path."""
        of_links = sigma[:, : self._layout.doppler].reshape(-1, self._layout.anchors, 4)
        return path_nis(x, P, self._anchors, paths.links, of_links.swapaxes(0, 1))

    def epoch(self, paths: PathEpoch, dt: float, deviations: Any = None, labels: Any = ()) -> Epoch:
        """Return an epoch in which each assigned path provides the values of its anchor's link.

        ``labels`` (L,) are the indices of the anchors' paths, and ``deviations`` those of
        :meth:`_sigma`. Without them, no anchor has a path, but odometry may be present.
        """
        layout = self._layout
        z = [0.0] * layout.size
        sigma = [1.0] * layout.size
        visible = [0.0] * len(layout.groups)
        snr = [0.0] * layout.anchors
        for anchor, path in enumerate(labels):
            if path != NO_PATH:
                rows = layout.link(anchor)
                z[rows] = paths.links[anchor, path].tolist()
                sigma[rows] = deviations[path, rows].tolist()
                visible[anchor] = 1.0
                snr[anchor] = float(paths.snr_db[path])
        if visible[0] and np.isfinite(doppler := paths.doppler[labels[0]]):
            z[layout.doppler] = float(doppler)
            sigma[layout.doppler] = float(deviations[labels[0], layout.doppler])
            visible[layout.anchors] = 1.0
        if layout.odometry and np.isfinite(paths.odometry).all():
            rows = slice(layout.doppler + 1, layout.size)
            z[rows] = paths.odometry.tolist()
            sigma[rows] = self._odometry_sigma
            visible[-1] = 1.0
        return Epoch(dt, z, sigma, visible, snr, paths.doppler_spread_hz)

    def _updated(self, track: PathTrack, time_s: float) -> PathTrack:
        """Return the track after the update with the measurements of its epoch."""
        epoch = track.epoch
        layout = self._layout
        site = Site(self._anchors, self._scene.hz_per_mps, track.x, track.P)
        after = predict_update(
            self._pipeline, self._mode, track.x, track.P, track.memory, epoch, site
        )
        memory = memory_before(track.memory, [after], epoch, layout)
        memory = memory_after(layout, 0.0, track.x, after, memory, epoch)
        seen_s = time_s if any(epoch.visible) else track.seen_s
        return track._replace(x=after.x, P=after.P, memory=memory, time_s=time_s, seen_s=seen_s)


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
    tracker = PathTracker(paths, scene, radio, mode)
    tracks, restarts, damage = _follow(paths, tracker)
    epochs = paths.epochs[: len(tracks)]
    labelled = [
        track.epoch if track else tracker.epoch(epoch, 0.0)
        for track, epoch in zip(tracks, epochs, strict=True)
    ]
    visible = np.array([epoch.visible for epoch in labelled]) > 0.5
    snr_db = np.array([epoch.snr_db for epoch in labelled])
    log = Log(
        layout=paths.layout,
        time_s=np.array([epoch.time_s for epoch in epochs]),
        measurement=np.array([epoch.z for epoch in labelled]),
        sigma=np.full((len(epochs), paths.layout.size), np.nan),
        visible=visible,
        incomplete=np.zeros_like(visible),
        doppler_anchor=np.zeros(len(epochs), np.int64),
        snr_db=np.where(visible[:, : paths.layout.anchors], snr_db, -np.inf),
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
