"""An EKF that estimates a user and the mirror images of the base station jointly.

A flat wall adds a virtual anchor, the mirror image of the base station (paper, Sec. II). Where the
images are unknown, they are appended to the user's state, with the complete covariance of all:

    x = [p v b  a_1 ... a_K],   a_k' = a_k + noise,   z = h(p, a_k) + noise

The user (7) is the paper's state. Each image (3,) is a position in m. A path of image k measures
the same four rows as a link of a known anchor at a_k, so dh/da = -dh/dp. This is simultaneous
localization and mapping (Durrant-Whyte and Bailey 2006) with a map of images.
:mod:`mmwave_env.localization.map_learning` decides which path belongs to which image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mmwave_env.filters.modes import Tuning
from mmwave_env.logs.log_tables import Arrays
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.models.measurement import direction, doppler_group, link_group
from mmwave_env.models.motion import COUPLED, white_noise_acceleration
from mmwave_env.models.prior import vector_from_link
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
    direct: Array  # (n, 4) variances if the path is the line of sight
    reflected: Array  # (n, 4) variances if a wall reflected it
    doppler_variance: Array  # (n,) Hz^2
    straight: Mask  # (n,) whether departure and arrival are opposite, as on the line of sight
    at_station: bool  # whether angles of arrival were measured at the base station


class Image(NamedTuple):
    """The history of a mirror image (virtual anchor) of the base station."""

    paths: int = 0  # number of its paths
    recent: tuple[bool, ...] = ()  # whether it had a path in the last epochs
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
    gradients = np.zeros((len(d), 4, 3))
    for k, row in enumerate([*rows, rows[1]]):  # both azimuths have the same gradient
        gradients[:, k] = np.column_stack(np.broadcast_arrays(*row[:3]))
    distance, azimuth, elevation = direction(list(d.T))
    return np.column_stack([distance, azimuth, elevation, azimuth + PI]), gradients


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


def difference(z: Array, h: Array) -> Array:
    """Return z - h (..., 4), with wrapped angles."""
    y = z - h
    y[..., 1:] = wrap(wrap(y[..., 1:]))
    return y


class ImageFilter:
    """The filter's equations for one base station (3,) and one motion model.

    ``offsets_m`` are the range offsets of the first anchors, of which only differences matter: that
    of the base station was subtracted from all ranges.
    """

    def __init__(
        self, station: Array, hz_per_mps: float, tuning: Tuning, offsets_m: Array | None = None
    ) -> None:
        self.station = station
        self._offsets_m = np.zeros(1) if offsets_m is None else offsets_m - offsets_m[0]
        self._hz_per_mps = hz_per_mps
        self._tuning = tuning

    def predicted(self, b: Belief, time_s: float) -> Belief:
        """Return the belief at a later time: x' = F x, P' = F P F' + Q."""
        dt = time_s - b.time_s
        t = self._tuning
        x = b.x.copy()
        P = b.P.copy()
        x[USER] += dt * x[VELOCITY]
        P[USER] += dt * P[VELOCITY]
        P[:, USER] += dt * P[:, VELOCITY]
        Q = white_noise_acceleration(
            [t.sigma_p**2, t.sigma_p**2, t.sigma_pz**2],
            [t.sigma_v**2, t.sigma_v**2, t.sigma_vz**2],
            (t.sigma_b_mps * self._hz_per_mps) ** 2,
            dt,
            t.coupling,
        )
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
        S[0] += paths.direct[:, :, None] * np.eye(LINK_ROWS)
        S[1:] += paths.reflected[:, :, None] * np.eye(LINK_ROWS)
        weighted = np.linalg.solve(S, y[..., None])[..., 0]
        return (y * weighted).sum(axis=-1), np.linalg.slogdet(S)[1]

    def updated(self, b: Belief, paths: Paths, labels: Mapping[int, int], nis: Array) -> Belief:
        """Return the belief after an EKF update with all assigned paths at once.

        The noise of a path whose NIS is large is inflated. ``nis`` is (A, n).
        """
        if not labels:
            return b
        h, H = self.rows(b, paths.at_station)
        anchors = list(labels)
        chosen = list(labels.values())
        doubtful = np.maximum(1.0, nis[anchors, chosen] / (LINK_ROWS * KNEE)) ** 2
        y = difference(paths.z[chosen], h[anchors]).ravel()
        variances = [(paths.reflected if a else paths.direct)[i] for a, i in labels.items()]
        R = (np.array(variances) * doubtful[:, None]).ravel()
        H = H[anchors].reshape(len(R), len(b.x))
        if 0 in labels and np.isfinite(paths.doppler[labels[0]]):
            shift = paths.doppler[labels[0]]
            variance = paths.doppler_variance[labels[0]]
            group = doppler_group(
                list(b.x), list(self.station), self._hz_per_mps, [shift], [variance]
            )
            (gradient,) = np.array(group.jacobian)
            (residual,) = group.innovation
            if residual**2 < DOPPLER_GATE * (gradient @ b.P @ gradient + variance):
                y = np.append(y, residual)
                H = np.vstack([H, gradient])
                R = np.append(R, variance)
        return _corrected(b, H, y, R)

    def image_updated(self, b: Belief, paths: Paths, anchor: int, path: int) -> Belief:
        """Return the belief after a path updated only its image (Schmidt-Kalman).

        The gain is zero elsewhere, so a false image cannot move the user.
        """
        h, H = self.rows(b, paths.at_station)
        y = difference(paths.z[path], h[anchor])
        return _corrected(b, H[anchor], y, paths.reflected[path], only=block(anchor))

    def with_image(self, b: Belief, paths: Paths, path: int) -> Belief:
        """Return the belief with a new image, from which this path seems to come.

        The image is a = p - d, where the path's link determines the vector d from the image to the
        user. So P_aa = P_pp + P_dd and P_ax = P_px. The image is as high as the base station, as
        walls are vertical.
        """
        sigma = np.sqrt(paths.reflected[path])
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
        variance = paths.reflected[path, 1:2]
        for _ in range(_ITERATIONS):
            h, H = self.rows(b, at_station=True)
            y = wrap(wrap(paths.z[path, 1:2] - h[-1, 1])) - H[-1, 1:2] @ (prior.x - b.x)
            b = _corrected(prior, H[-1, 1:2], y, variance, only=newest)
        return b


def _corrected(b: Belief, H: Array, y: Array, R: Array, only: slice | None = None) -> Belief:
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
    kept = [anchor for anchor, keeps in enumerate(keep, start=1) if keeps]
    index = np.concatenate([np.arange(STATE_SIZE), *(np.r_[block(a)] for a in kept)])
    numbers = {0: 0} | {old: new for new, old in enumerate(kept, start=1)}
    labels = {numbers[a]: path for a, path in b.labels.items() if a in numbers}
    images = tuple(b.images[a - 1] for a in kept)
    return b._replace(x=b.x[index], P=b.P[np.ix_(index, index)], images=images, labels=labels)


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
