"""Tracker that follows users by propagation paths whose anchors are unknown.

The anchors are the base station and its mirror images. A track begins with the hypothesis that a
certain path is the line of sight. This path determines a position, and the paths of the next epochs
confirm or contradict the hypothesis. Tracks are immutable, so several can be tried side by side.

Paths are assigned to anchors by global nearest neighbor (Blackman and Popoli 1999, Sec. 6.4). Each
path and each anchor is used at most once. A path may belong to an anchor only if the pair's NIS is
below a limit, the gate. The assignment with the smallest sum of NIS is chosen; an anchor without a
path adds the gate to this sum. An EKF, linearized at the prediction, computes the NIS.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.gating import innovation_statistics
from mmwave_env.filters.linearization import Tangent
from mmwave_env.filters.memory import Memory, initial_memory, memory_after, memory_before
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, predict, predict_update
from mmwave_env.localization.segments import gives_fix
from mmwave_env.logs.log import PathEpoch
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site, link_group, seen_from_image
from mmwave_env.models.prior import GAP_S, prior_from_fix
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.linalg import cholesky, pack
from mmwave_env.numerics.numbers import Array, Index, Matrix, Vector

NO_PATH = -1


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


def assign(nis: Array, gate: float) -> Index:
    """Return the indices (L,) of the anchors' paths; ``NO_PATH`` for an anchor without a path.

    ``nis`` is (L, n); a path may belong to an anchor only if its NIS is below ``gate``.
    """
    from scipy.optimize import linear_sum_assignment

    labels = np.full(len(nis), NO_PATH)
    # A pair outside the gate costs as much as an anchor without a path. It is discarded below.
    anchors, paths = linear_sum_assignment(np.minimum(np.nan_to_num(nis, nan=np.inf), gate))
    inside = nis[anchors, paths] < gate
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


GATE_QUANTILE = 0.99  # a path may belong to an anchor if its NIS is below this chi-square quantile
CLEARLY_MORE = 0.5  # additional paths per epoch that a new track must explain to replace another


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


class _Links(NamedTuple):
    """The n paths of an epoch, each converted to L links, one for each anchor."""

    # z, sigma: (L, n, 4) values of the links and their standard deviations, m and rad
    z: Array
    sigma: Array
    # (n,) standard deviation, Hz, of each path's Doppler shift, assuming that the path comes
    # directly from the base station
    doppler_sigma: Array


class PathTracker:
    """A tracker that follows users by propagation paths.

    :func:`~mmwave_env.localization.association.associate` describes all arguments except
    ``layout``, which is the layout of the log.
    """

    def __init__(self, scene: Scene, radio: Radio, mode: Mode, layout: Layout) -> None:
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
        links = self._links(paths)
        coming = self.nothing(paths, paths.time_s - track.time_s)
        hz_per_mps = self._scene.hz_per_mps
        gamma = track.memory.gamma
        x, P = predict(self._pipeline, self._mode, track.x, track.P, gamma, coming, hz_per_mps)
        labels = assign(path_nis(x, P, self._anchors, links.z, links.sigma), self._gate)
        epoch = self._with_labels(coming, paths, links, labels)
        return self._updated(track._replace(labels=labels, epoch=epoch), paths)

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
        links = self._links(paths)
        sights = links.z[0]
        likely = gives_fix(sights) & (disagreement(sights, links.sigma[0]) < self._disagreement)
        if track:
            likely[track.labels[track.labels != NO_PATH]] = False
            if track.labels[0] != NO_PATH:  # no path is shorter than the line of sight
                likely &= sights[:, 0] < sights[track.labels[0], 0]
        for path in np.flatnonzero(likely):
            begun = self._begin(paths, links, int(path))
            if begun:
                yield begun

    def _begin(self, paths: PathEpoch, links: _Links, path: int) -> PathTrack | None:
        """Return a track with this path as line of sight; None if a wall would block this path."""
        anchors = self._scene.anchors_m
        mean, covariance = prior_from_fix(
            anchors[0], links.z[0, path], links.sigma[0, path], self._radio, self._scene
        )
        distance = np.linalg.norm(mean[:3] - anchors, axis=1)
        if distance.argmin() != 0:  # a position behind a wall is nearest to a mirror image
            return None
        x = mean.tolist()
        P = covariance.tolist()
        nis = path_nis(x, P, self._anchors, links.z, links.sigma)
        nis[0] = np.inf
        nis[:, path] = np.inf
        labels = assign(nis, self._gate)
        epoch = self._with_labels(self.nothing(paths), paths, links, labels)
        prior = PathTrack(x, pack(P), self._memory, paths.time_s, paths.time_s, labels, epoch)
        track = self._updated(prior, paths)
        labels[0] = path
        return track._replace(epoch=self._with_labels(epoch, paths, links, labels))

    def _links(self, paths: PathEpoch) -> _Links:
        layout = self._layout
        n = len(paths.snr_db)
        snr = np.repeat(paths.snr_db[:, None], layout.anchors, axis=1)
        sigma = self._radio.sigma(snr, self._scene, layout)
        of_links = sigma[:, : layout.doppler].reshape(n, layout.anchors, 4).swapaxes(0, 1)
        z = np.broadcast_to(paths.measurement[:, :4], of_links.shape).copy()
        if paths.at_station:
            for link, anchor in zip(z, self._anchors, strict=True):
                link[:, 1], link[:, 2] = seen_from_image(
                    link[:, 1], link[:, 2], self._anchors[0], anchor
                )
        return _Links(z, of_links, sigma[:, layout.doppler])

    def nothing(self, paths: PathEpoch, dt: float = 0.0) -> Epoch:
        """Return an epoch in which no path belongs to an anchor, but odometry may be present."""
        layout = self._layout
        z = [0.0] * layout.size
        sigma = [1.0] * layout.size
        visible = [0.0] * len(layout.groups)
        snr = [0.0] * layout.anchors
        if layout.odometry and np.isfinite(paths.odometry).all():
            rows = slice(layout.doppler + 1, layout.size)
            z[rows] = paths.odometry.tolist()
            sigma[rows] = self._odometry_sigma
            visible[-1] = 1.0
        return Epoch(dt, z, sigma, visible, snr, paths.doppler_spread_hz)

    def _with_labels(self, epoch: Epoch, paths: PathEpoch, links: _Links, labels: Index) -> Epoch:
        """Return the epoch in which each assigned path provides the values of its anchor's link."""
        layout = self._layout
        z = list(epoch.z)
        sigma = list(epoch.sigma)
        visible = list(epoch.visible)
        snr = list(epoch.snr_db)
        for anchor in np.flatnonzero(labels != NO_PATH).tolist():
            path = labels[anchor]
            rows = layout.link(anchor)
            z[rows] = links.z[anchor, path].tolist()
            sigma[rows] = links.sigma[anchor, path].tolist()
            visible[anchor] = 1.0
            snr[anchor] = float(paths.snr_db[path])
        sight = labels[0]
        row = layout.doppler
        doppler = float(paths.measurement[sight, 4]) if sight != NO_PATH else np.nan
        if np.isfinite(doppler):
            z[row] = doppler
            sigma[row] = float(links.doppler_sigma[sight])
            visible[layout.anchors] = 1.0
        return epoch._replace(z=z, sigma=sigma, visible=visible, snr_db=snr)

    def _updated(self, track: PathTrack, paths: PathEpoch) -> PathTrack:
        """Return the track after the update with the measurements of its epoch."""
        epoch = track.epoch
        layout = self._layout
        site = Site(self._anchors, self._scene.hz_per_mps, track.x, track.P)
        after = predict_update(
            self._pipeline, self._mode, track.x, track.P, track.memory, epoch, site
        )
        memory = memory_before(track.memory, [after], epoch, layout)
        memory = memory_after(layout, 0.0, track.x, after, memory, epoch.dt, epoch.visible)
        seen_s = paths.time_s if any(epoch.visible) else track.seen_s
        return track._replace(
            x=after.x, P=after.P, memory=memory, time_s=paths.time_s, seen_s=seen_s
        )
