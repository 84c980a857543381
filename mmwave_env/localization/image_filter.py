"""An EKF that estimates a user and the mirror images of the base station jointly.

A flat wall adds a virtual anchor, the mirror image of the base station (paper, Sec. II). Where the
images are unknown, they are appended to the user's state, with the complete covariance of all:

    x = [p v b  a_1 ... a_K],   a_k' = a_k + noise,   z = h(p, a_k) + noise

The user (7) is the paper's state. Each image (3,) is a position in m. A path of image k measures
the same four rows as a link of a known anchor at a_k, so dh/da = -dh/dp. This is simultaneous
localization and mapping (Durrant-Whyte and Bailey 2006) with a map of images.

Two subclasses decide which path belongs to which image: ``PathTracker`` in ``association.py``,
where the images are known, and ``MapLearner`` in ``map_learning.py``, where they are not. Beliefs
are immutable, so that several ways can be tried side by side.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import process_noise
from mmwave_env.localization.first_position import HEIGHT_SIGMA_M
from mmwave_env.localization.starts import gives_fix
from mmwave_env.logs.log import PathLog
from mmwave_env.logs.log_tables import Arrays
from mmwave_env.models.layout import STATE_SIZE, Layout
from mmwave_env.models.measurement import Epoch, direction, doppler_group, link_group
from mmwave_env.models.motion import COUPLED
from mmwave_env.models.prior import prior_from_fix, vector_from_link
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI, Array, Mask, wrap

LINK_ROWS = 4
KNEE = 1.5  # NIS per row from which the noise of a path is inflated
VERTICAL_M = 0.1  # deviation of an image's height from the base station's: walls are vertical
IMAGE_NOISE_M = 0.02  # m / sqrt(s), because errors of reflected paths are correlated
MERGED_BELOW = chdtri(3, 0.01)  # images are equal if their difference is below the 99 % quantile
MERGED_SIGMA_M = 3.0  # maximum standard deviation of this difference
DOPPLER_GATE = chdtri(1, 0.01)  # 99 % gate of the Doppler shift
UNKNOWN_RAD = 1e3  # deviation of an angle about which nothing is known
_ITERATIONS = 4  # of the first update of an image with an arrival at the base station
USER = slice(0, 3)  # place of the user's position in the state
VELOCITY = slice(3, 6)


@dataclass(frozen=True, eq=False)
class Paths(Arrays):
    """The n paths of an epoch, with the variances of their values."""

    time_s: float
    z: Array  # (n, 4) links: range (m), azimuth and elevation of arrival, departure (rad)
    doppler: Array  # (n,) Doppler shift, Hz; NaN where not measured
    variance: Array  # (n, 2, 4) if the path is the line of sight; if a wall reflected it
    doppler_variance: Array  # (n,) Hz^2
    straight: Mask  # (n,) whether departure and arrival are opposite, as on the line of sight
    at_station: bool  # whether angles of arrival were measured at the base station


class Image(NamedTuple):
    """The history of a mirror image (virtual anchor) of the base station."""

    paths: int = 0  # number of its paths
    epochs: int = 0  # since its birth
    missed: int = 0  # epochs since its last path
    nis: float = 0.0  # sum of NIS while tentative
    confirmed: bool = False
    exact: bool = False  # whether the scene states its position, so that nothing is to be learned


class Doubt(NamedTuple):
    """Counters of successive epochs that make a track doubtful."""

    unused: int = 0  # with paths, but none of them was used
    blind: int = 0  # with paths, but without a line of sight
    short: int = 0  # with a path that is shorter than the line of sight


class Belief(NamedTuple):
    """The belief about the user and the map after an epoch."""

    x: Array  # (7 + 3 K,)
    P: Array  # (7 + 3 K, 7 + 3 K)
    images: tuple[Image, ...]  # K
    time_s: float
    tracked: bool = True  # whether the user's part of the state is meaningful
    doubt: Doubt = Doubt()
    # the index of the path that updated each anchor (0: base station, k: image k) in this epoch
    labels: Mapping[int, int] = MappingProxyType({})
    evidence: float = 0.0  # log-likelihood of all assigned paths against false ones, in this epoch
    begins: bool = False  # whether the track begins in this epoch

    @property
    def places(self) -> Array:
        """Return the positions (K, 3) of the images, m."""
        return self.x[STATE_SIZE:].reshape(-1, 3)


def block(anchor: int) -> slice:
    """Return the place of the position of an anchor >= 1 in the state."""
    first = STATE_SIZE + 3 * (anchor - 1)
    return slice(first, first + 3)


def links_along(d: Array) -> tuple[Array, Array]:
    """Return the links h (A, 4) along vectors d (A, 3), and their gradients (A, 4, 3) by d."""
    still = [0.0] * 4
    rows = link_group([*d.T, *still], still, still, [1.0] * 4).jacobian
    rows = [*rows, rows[1]]  # both azimuths have the same gradient
    gradients = [np.column_stack(np.broadcast_arrays(*row[:3])) for row in rows]
    distance, azimuth, elevation = direction(list(d.T))
    h = np.column_stack([distance, azimuth, elevation, azimuth + PI])
    return h, np.stack(gradients, axis=1)


def link_rows(p: Array, anchors: Array, at_station: bool) -> tuple[Array, Array, Array]:
    """Return the links h (A, 4) of a user at p (3,), and dh/dp, dh/da (A, 4, 3).

    The first of the anchors (A, 3) is the base station g. With ``at_station``, arrivals are
    directions at g: the direction d = p - a at the image is mirrored in the wall, to
    q = d - 2 (d.m) m / m.m with m = a - g.
    """
    d = p - anchors
    h, by_p = links_along(d)
    by_a = -by_p
    if at_station and len(anchors) > 1:
        m = anchors[1:] - anchors[0]
        d = d[1:, None, :]
        mm = (m * m).sum(axis=1)[:, None, None]
        m_rows = m[:, None, :]
        dm = (d * m_rows).sum(axis=2, keepdims=True)
        outer = m[:, :, None] * m_rows
        mirror = np.eye(3) - 2.0 * outer / mm
        mirrored, slopes = links_along((d @ mirror)[:, 0])
        angles = slice(1, 3)
        h[1:, angles] = mirrored[:, angles]
        # the gradient of q by a, with d and m both changing
        tilt = 4.0 * dm / mm**2 * outer - 2.0 / mm * (dm * np.eye(3) + m[:, :, None] * d)
        by_p[1:, angles] = slopes[:, angles] @ mirror
        by_a[1:, angles] = slopes[:, angles] @ (tilt - mirror)
    return h, by_p, by_a


def disagreement(paths: Array, variance: Array) -> Array:
    """Compute the NIS (n,) of the difference between the two azimuths of paths (n, 4).

    The variances are (n, 4). The NIS has 1 degree of freedom. The user's position is not needed,
    because the azimuths of arrival and departure measure the same bearing (paper, Sec. II-B).
    """
    apart = wrap(wrap(paths[:, 3] - paths[:, 1] + PI))
    return apart**2 / (variance[:, 1] + variance[:, 3])  # type: ignore[no-any-return]


def difference(z: Array, h: Array) -> Array:
    """Return z - h (..., 4), with wrapped angles."""
    y = z - h
    y[..., 1:] = wrap(wrap(y[..., 1:]))
    return y


class ImageFilter(ABC):
    """The filter's equations; a subclass decides which path belongs to which image.

    Args:
        scene: scene with the base station, and perhaps with known or learned images.
        radio: profile of the receiver; it determines the noise at each SNR, and the prior.
        mode: filter mode whose process noise is used. Choose a mode for high mobility: the gates
            around its uncertain predictions are wide enough for any user.
    """

    # a path may be the line of sight if the NIS of the difference of its azimuths is smaller
    straight = float(chdtri(1, 0.01))

    def __init__(self, scene: Scene, radio: Radio, mode: Mode) -> None:
        self._scene = scene
        self._radio = radio
        self._tuning = mode.tuning
        self.station = scene.anchors_m[0]
        # The base station's offset was subtracted from all ranges; learned images have the same.
        known = len(scene.offsets_m) - len(scene.learned)
        self._offsets_m = (scene.offsets_m - scene.offsets_m[0])[:known]

    def observed(self, log: PathLog) -> Iterator[Paths]:
        """Yield the paths of each epoch, with the receiver's variances, else those at their SNR."""
        scene = replace(self._scene, range_offset_m=(), range_offset_sigma_m=())
        usual = self._radio.sigma(np.column_stack([log.snr_db] * 2), scene, Layout(2)) ** 2
        own = np.minimum(log.sigma, UNKNOWN_RAD)[:, None] ** 2
        variance = np.where(np.isfinite(own), own, usual[:, :-1].reshape(-1, 2, LINK_ROWS))
        variance[..., 0] += self._scene.offset_sigmas_m.max() ** 2
        z = log.links
        straight = gives_fix(z) & (disagreement(z, variance[:, 0]) < self.straight)
        doppler = log.table["doppler"]
        every = Paths(0.0, z, doppler, variance, usual[:, -1], straight, log.at_station)
        for time_s, rows in zip(log.time_s.tolist(), log.epochs, strict=True):
            yield replace(every.part(rows), time_s=time_s)

    @cached_property
    def start(self) -> Belief:
        """Return the belief about the scene's images, before a track begins."""
        learned = self._scene.learned
        exact = len(self._offsets_m) - 1
        histories = [Image(confirmed=True, exact=True)] * exact
        histories += [Image(image.paths, confirmed=True) for image in learned]
        sigma = np.append(np.zeros(STATE_SIZE + 3 * exact), [image.sigma_m for image in learned])
        x = np.append(np.zeros(STATE_SIZE), self._scene.anchors_m[1:])
        return Belief(x, np.diag(sigma**2), tuple(histories), -np.inf, tracked=False)

    def prior(self, b: Belief, paths: Paths, path: int, anchor: int = 0) -> Belief:
        """Return a belief about a user whose line of sight is a path; the images stay.

        With an ``anchor``, the path comes from this image, whose place is known.

        If the path has no elevation, the height of the streets is known roughly.
        """
        z = paths.z[path].copy()
        z[0] -= self._offsets_m[anchor]
        sigma = np.sqrt(paths.variance[path, min(anchor, 1)])
        if sigma[2] >= UNKNOWN_RAD:
            sigma[2] = HEIGHT_SIGMA_M / z[0]
        mean, covariance = prior_from_fix(
            self._scene.anchors_m[anchor], z, sigma, self._radio, self._scene
        )
        x = b.x.copy()
        P = b.P.copy()
        P[:STATE_SIZE] = 0.0
        P[:, :STATE_SIZE] = 0.0
        x[:STATE_SIZE] = mean
        P[:STATE_SIZE, :STATE_SIZE] = covariance
        return Belief(x, P, b.images, paths.time_s)

    def begun(self, prior: Belief, paths: Paths, path: int, anchor: int = 0) -> Belief:
        """Return a track that begins with a :meth:`prior`, after an update with the other paths."""
        others = np.arange(len(paths)) != path
        b = self.step(prior, paths.part(others), sight_used=True)
        labels = {anchor: i + (i >= path) for anchor, i in b.labels.items()}
        return b._replace(labels={**labels, anchor: path}, begins=True)

    @abstractmethod
    def step(self, b: Belief, paths: Paths, sight_used: bool = False) -> Belief:
        """Return the belief after an epoch.

        With ``sight_used``, the base station's path was used before, and is not among the paths.
        """

    def ahead(self, b: Belief, coming: Iterable[Paths], blocked: bool = False) -> tuple[float, int]:
        """Return the evidence and the number of used paths in coming epochs.

        If the line of sight is ``blocked``, they have none.
        """
        evidence = 0.0
        used = 0
        for paths in coming:
            b = self.step(b, paths, blocked)
            evidence += b.evidence
            used += len(b.labels)
        return evidence, used

    def predicted(self, b: Belief, time_s: float) -> Belief:
        """Return the belief at a later time: x' = F x, P' = F P F' + Q."""
        dt = time_s - b.time_s
        x = b.x.copy()
        P = b.P.copy()
        x[USER] += dt * x[VELOCITY]
        P[USER] += dt * P[VELOCITY]
        P[:, USER] += dt * P[:, VELOCITY]
        step = Epoch(dt, [], [], [], [], doppler_spread_hz=0.0)
        Q = process_noise(self._tuning, step, self._scene.hz_per_mps, gamma=1.0, planar=False)
        learned = np.repeat([not image.exact for image in b.images], 3)
        P[np.diag_indices(len(x))] += np.append(Q.diagonal, IMAGE_NOISE_M**2 * dt * learned)
        for (i, j), covariance in zip(COUPLED, Q.coupling, strict=False):
            P[i, j] += covariance
            P[j, i] += covariance
        return b._replace(x=x, P=P, time_s=time_s, labels={}, evidence=0.0, begins=False)

    def rows(self, b: Belief, at_station: bool) -> tuple[Array, Array]:
        """Return the links (A, 4) to all anchors, and their Jacobians (A, 4, 7 + 3 K)."""
        anchors = np.vstack([self.station, b.places])
        h, by_p, by_a = link_rows(b.x[USER], anchors, at_station)
        h[: len(self._offsets_m), 0] += self._offsets_m
        H = np.zeros((*h.shape, len(b.x)))
        H[:, :, USER] = by_p
        for anchor in range(1, len(h)):
            H[anchor, :, block(anchor)] = by_a[anchor]
        return h, H

    def nis(self, b: Belief, paths: Paths) -> tuple[Array, Array]:
        """Return NIS and ln det S (A, n) of every pair of an anchor and a path."""
        h, H = self.rows(b, paths.at_station)
        y = difference(paths.z[None], h[:, None])
        S = np.repeat((H @ b.P @ H.transpose(0, 2, 1))[:, None], len(paths), axis=1)
        direct, reflected = paths.variance.swapaxes(0, 1)[..., None] * np.eye(LINK_ROWS)
        S[0] += direct
        S[1:] += reflected
        weighted = np.linalg.solve(S, y[..., None])[..., 0]
        return (y * weighted).sum(axis=-1), np.linalg.slogdet(S)[1]

    def updated(
        self,
        b: Belief,
        paths: Paths,
        labels: Mapping[int, int],
        nis: Array,
        only: slice | None = None,
    ) -> Belief:
        """Return the belief after an EKF update with all assigned paths at once.

        The noise of a path whose NIS is large is inflated. ``nis`` is (A, n). With ``only``, no
        other part of the state changes (Schmidt-Kalman).
        """
        if not labels:
            return b
        h, H = self.rows(b, paths.at_station)
        anchors = list(labels)
        chosen = list(labels.values())
        doubtful = np.maximum(1.0, nis[anchors, chosen] / (LINK_ROWS * KNEE)) ** 2
        y = difference(paths.z[chosen], h[anchors]).ravel()
        R = (paths.variance[chosen, np.sign(anchors)] * doubtful[:, None]).ravel()
        H = H[anchors].reshape(len(R), len(b.x))
        if 0 in labels and np.isfinite(paths.doppler[labels[0]]):
            shift = paths.doppler[labels[0]]
            variance = paths.doppler_variance[labels[0]]
            hz_per_mps = self._scene.hz_per_mps
            group = doppler_group(list(b.x), list(self.station), hz_per_mps, [shift], [variance])
            (gradient,) = np.array(group.jacobian)
            (residual,) = group.innovation
            if residual**2 < DOPPLER_GATE * (gradient @ b.P @ gradient + variance):
                y = np.append(y, residual)
                H = np.vstack([H, gradient])
                R = np.append(R, variance)
        return _corrected(b, H, y, R, only)

    def with_image(self, b: Belief, paths: Paths, path: int) -> Belief:
        """Return the belief with a new image, from which this path seems to come.

        The image is a = p - d, where the path's link determines the vector d from the image to the
        user. So P_aa = P_pp + P_dd and P_ax = P_px. The image is as high as the base station, as
        walls are vertical.
        """
        sigma = np.sqrt(paths.variance[path, 1])
        if paths.at_station:
            sigma[1] = UNKNOWN_RAD
        away, covariance = vector_from_link(paths.z[path], sigma)
        P_xp = b.P[:, USER]
        P = np.block([[b.P, P_xp], [P_xp.T, b.P[USER, USER] + covariance]])
        x = np.append(b.x, b.x[USER] - away)
        b = b._replace(x=x, P=P, images=(*b.images, Image()))
        if paths.at_station:
            b = self._turned(b, paths, path)
        height = np.zeros((1, len(x)))
        height[0, -1] = 1.0
        y = np.array([self.station[2] - b.x[-1]])
        return _corrected(b, height, y, np.array([VERTICAL_M**2]), only=block(len(b.images)))

    def _turned(self, b: Belief, paths: Paths, path: int) -> Belief:
        """Return the belief after the arrival at the base station updated the newest image.

        It determines the direction of the wall. The update is iterated, as it may be far away
        (Bar-Shalom et al. 2001, Sec. 10.5.2).
        """
        newest = block(len(b.images))
        prior = b
        variance = paths.variance[path, 1, 1:2]
        for _ in range(_ITERATIONS):
            h, H = self.rows(b, at_station=True)
            y = wrap(wrap(paths.z[path, 1:2] - h[-1, 1])) - H[-1, 1:2] @ (prior.x - b.x)
            b = _corrected(prior, H[-1, 1:2], y, variance, only=newest)
        return b


def _corrected(b: Belief, H: Array, y: Array, R: Array, only: slice | None) -> Belief:
    """Return the belief after a Kalman update with innovation y (m,) and variances R (m,).

    The gain is zero outside of ``only``, a part of the state. For any gain K, the covariance is
    P - K H P - (K H P)' + K S K' with S = H P H' + R, which takes fewer steps than Joseph's form.
    """
    PH = b.P @ H.T
    S = H @ PH + np.diag(R)
    K = np.linalg.solve(S, PH.T).T
    if only is not None:
        K[: only.start] = 0.0
        K[only.stop :] = 0.0
    half = K @ (PH - 0.5 * K @ S).T
    return b._replace(x=b.x + K @ y, P=b.P - half - half.T)


def reduced(b: Belief, keep: Sequence[bool]) -> Belief:
    """Return the belief with only some of its images."""
    if all(keep):
        return b
    some = np.append(np.ones(STATE_SIZE, np.bool_), np.repeat(keep, 3))
    kept = [0, *np.flatnonzero(keep) + 1]
    labels = {new: b.labels[old] for new, old in enumerate(kept) if old in b.labels}
    images = tuple(compress(b.images, keep))
    return b._replace(x=b.x[some], P=b.P[np.ix_(some, some)], images=images, labels=labels)


def merged(b: Belief) -> Belief:
    """Return the belief without images that may be equal to another one with more paths."""
    keep = [True] * len(b.images)
    for j, k in np.argwhere(np.tril(_equal(b), -1)).tolist():
        if keep[j] and keep[k]:
            older = b.images[k].exact or b.images[k].paths >= b.images[j].paths
            keep[j if older else k] = False
    return reduced(b, keep)


def _equal(b: Belief) -> Mask:
    """Tell which images (K, K) are equal, as far as their covariance can tell."""
    K = len(b.images)
    P = b.P[STATE_SIZE:, STATE_SIZE:].reshape(K, 3, K, 3).transpose(0, 2, 1, 3)
    own = np.einsum("kkij->kij", P)
    D = own[:, None] + own - P - P.transpose(1, 0, 2, 3) + 1e-9 * np.eye(3)
    e = b.places[:, None] - b.places
    distance = (e * np.linalg.solve(D, e[..., None])[..., 0]).sum(axis=-1)
    known = np.trace(D, axis1=-2, axis2=-1) < MERGED_SIGMA_M**2
    return known & (distance < MERGED_BELOW)  # type: ignore[no-any-return]
