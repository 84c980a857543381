"""Kalman filters as the textbook has them: numpy, every row at once, nothing from the package.

Rows of a measurement, for anchors l = 1..L: [range, azimuth and elevation of arrival, azimuth
of departure] each, then the Doppler shift of anchor 1, then, optionally, [speed, heading].
Seen from within NEAREST_M of the vertical of an anchor its azimuths are silent, from within that of
the anchor itself its elevation and Doppler shift, too: no residual, no gradient, no spread.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

NEAREST_M = 1e-3


def inverse(length):
    return 1.0 / length if length > NEAREST_M else 0.0


@dataclass(frozen=True)
class Sensor:
    """Where the anchors (L, 3) stand, f_c / c in Hz per m/s, and whether there is odometry."""

    anchors: np.ndarray
    hz_per_mps: float
    odometry: bool = False

    @property
    def links(self):
        return len(self.anchors)

    @property
    def groups(self):
        rows = [slice(4 * i, 4 * i + 4) for i in range(self.links)]
        rows.append(slice(4 * self.links, 4 * self.links + 1))
        if self.odometry:
            rows.append(slice(4 * self.links + 1, 4 * self.links + 3))
        return rows

    @property
    def angles(self):
        angles = np.tile([False, True, True, True], self.links).tolist() + [False]
        return np.array(angles + [False, True] * self.odometry)

    def h(self, x):
        z = []
        for anchor in self.anchors:
            east, north, up = x[:3] - anchor
            azimuth = np.arctan2(north, east)
            elevation = np.arctan2(up, np.hypot(east, north))
            z += [np.sqrt(east**2 + north**2 + up**2), azimuth, elevation, azimuth + np.pi]
        d = x[:3] - self.anchors[0]
        z.append(self.hz_per_mps * (d @ x[3:6]) / max(np.sqrt(d @ d), NEAREST_M) + x[6])
        if self.odometry:
            z += [np.sqrt(x[3:6] @ x[3:6]), np.arctan2(x[4], x[3])]
        return np.array(z)

    def jacobian(self, x):
        H = []
        for anchor in self.anchors:
            d = x[:3] - anchor
            east, north, up = d
            rho = np.sqrt(east**2 + north**2)
            i, j = inverse(np.sqrt(d @ d)), inverse(rho)
            azimuth = [-north * j**2, east * j**2, 0, 0, 0, 0, 0]
            elevation = [-east * up * i**2 * j, -north * up * i**2 * j, rho * i**2, 0, 0, 0, 0]
            H += [[*(d * i), 0, 0, 0, 0], azimuth, elevation, azimuth]
        d, v = x[:3] - self.anchors[0], x[3:6]
        i = inverse(np.sqrt(d @ d))
        u = d * i
        across = (np.eye(3) - np.outer(u, u)) @ v * i
        H.append([*(self.hz_per_mps * across), *(self.hz_per_mps * u), i > 0.0])
        if self.odometry:
            vx, vy, _ = v
            H.append([0, 0, 0, *(v / np.sqrt(v @ v)), 0])
            H.append([0, 0, 0, -vy / (vx**2 + vy**2), vx / (vx**2 + vy**2), 0, 0])
        return np.array(H)

    def silent(self, x):
        """Rows (rows,) that tell nothing of a state."""
        d = x[:3] - self.anchors
        on_vertical = np.hypot(d[:, 0], d[:, 1]) <= NEAREST_M
        there = np.sqrt((d * d).sum(axis=1)) <= NEAREST_M
        never = np.zeros(self.links, bool)
        links = np.column_stack([never, on_vertical, there, on_vertical])
        return np.array([*links.ravel(), there[0], *[False, False] * self.odometry])

    def difference(self, a, b):
        """a - b, angles in [-pi, pi)."""
        wrapped = (a - b + np.pi) % (2 * np.pi) - np.pi
        return np.where(self.angles, wrapped, a - b)

    def residual(self, a, b, x):
        """a - b as far as it tells something at x."""
        return np.where(self.silent(x), 0.0, self.difference(a, b))


@dataclass(frozen=True)
class Restricted:
    """A sensor of some components of the state, the others being known exactly."""

    sensor: Sensor
    known: np.ndarray
    free: list[int]

    def _whole(self, x):
        whole = self.known.copy()
        whole[self.free] = x
        return whole

    def h(self, x):
        return self.sensor.h(self._whole(x))

    def jacobian(self, x):
        return self.sensor.jacobian(self._whole(x))[:, self.free]

    def residual(self, a, b, x):
        return self.sensor.residual(a, b, self._whole(x))


def F(dt):
    return np.eye(7) + dt * np.eye(7, k=3) * (np.arange(7) < 3)[:, None]


def predict(x, P, Q, dt):
    return F(dt) @ x, F(dt) @ P @ F(dt).T + Q


def rts(x, P, P_predicted, time_s, free=range(7), x_predicted=None):
    """Rauch-Tung-Striebel over one track (T, ...); only the ``free`` components are uncertain.

    ``x_predicted`` (T, 7) is F x where none is given.
    """
    if x_predicted is None:
        steps = zip(np.diff(time_s, prepend=np.nan), np.roll(x, 1, axis=0), strict=True)
        x_predicted = [F(dt) @ before for dt, before in steps]
    x, P, block = x.copy(), P.copy(), np.ix_(free, free)
    for t in reversed(range(len(x) - 1)):
        Ft, gain = F(time_s[t + 1] - time_s[t]), np.zeros((7, 7))
        gain[block] = (P[t] @ Ft.T)[block] @ np.linalg.inv(P_predicted[t + 1][block])
        x[t] += gain @ (x[t + 1] - x_predicted[t + 1])
        P[t] += gain @ (P[t + 1] - P_predicted[t + 1]) @ gain.T
    return x, P


class Moments(NamedTuple):
    """Of the predicted measurement: mean, covariance without noise, covariance with the state."""

    mean: np.ndarray
    S: np.ndarray
    C: np.ndarray


def tangent(sensor, x, P):
    """Extended Kalman filter."""
    H = sensor.jacobian(x)
    return Moments(sensor.h(x), H @ P @ H.T, P @ H.T)


def unscented(alpha, beta, kappa):
    """Scaled unscented transform (van der Merwe 2004)."""

    def moments(sensor, x, P):
        n = len(x)
        scale = alpha**2 * (n + kappa)
        columns = np.linalg.cholesky(scale * P).T
        points = np.vstack([x, x + columns, x - columns])
        mean_weights = np.full(2 * n + 1, 0.5 / scale)
        mean_weights[0] = 1.0 - n / scale
        weights = mean_weights.copy()
        weights[0] += 1.0 - alpha**2 + beta
        return _moments(sensor, x, points, mean_weights, weights)

    return moments


def cubature(sensor, x, P):
    """Third-degree spherical-radial rule (Arasaratnam and Haykin 2009)."""
    n = len(x)
    columns = np.sqrt(n) * np.linalg.cholesky(P).T
    weights = np.full(2 * n, 0.5 / n)
    return _moments(sensor, x, np.vstack([x + columns, x - columns]), weights, weights)


def _moments(sensor, x, points, mean_weights, weights):
    center = sensor.h(x)
    relative = np.array([sensor.residual(sensor.h(point), center, x) for point in points])
    shift = mean_weights @ relative
    spread = relative - shift
    S = (spread.T * weights) @ spread
    return Moments(center + shift, S, ((points - x).T * weights) @ spread)


METHODS: dict[str, Callable[..., Moments]] = {
    "ekf": tangent,
    "ukf": unscented(1.0, 2.0, 0.0),
    "ckf": cubature,
}


class Update(NamedTuple):
    x: np.ndarray
    P: np.ndarray
    nis: np.ndarray
    accepted: np.ndarray
    log_likelihood: float


def statistics(moments, sensor, groups, x, P, z, R):
    """Innovation covariance (rows, rows), and NIS and log det S of every group."""
    mean, S, _ = moments(sensor, x, P)
    S = S + np.diag(R)
    y = sensor.residual(z, mean, x)
    nis = np.array([y[g] @ np.linalg.inv(S[g, g]) @ y[g] for g in groups])
    return S, nis, np.array([np.log(np.linalg.det(S[g, g])) for g in groups])


class Judged(NamedTuple):
    nis: np.ndarray
    accepted: np.ndarray
    R: np.ndarray
    log_likelihood: float


def gate_groups(
    moments, sensor, groups, links, x, P, z, R, visible, quantile=None, force=False, robust=False
):
    """Gate each group at the prior; R is inflated where a robust update doubts."""
    _, nis, log_det = statistics(moments, sensor, groups, x, P, z, R)
    sizes = np.array([g.stop - g.start for g in groups])
    is_link = np.arange(len(groups)) < links
    passed = np.ones(len(groups), bool) if quantile is None else nis <= chi2.ppf(quantile, sizes)
    if force or robust:
        passed = passed | is_link
    if robust:
        doubt = np.where(is_link, np.maximum(nis / (1.5 * sizes), 1.0) ** 2, 1.0)
        R = R * np.repeat(doubt, sizes)
    log_likelihood = -0.5 * np.sum((nis + log_det)[visible])
    return Judged(np.where(visible, nis, 0.0), visible & passed, R, log_likelihood)


def update(moments, sensor, groups, links, x, P, z, R, *gate):
    """Gate each group at the prior, then condition on all rows of those that passed."""
    nis, accepted, R, log_likelihood = gate_groups(
        moments, sensor, groups, links, x, P, z, R, *gate
    )
    keep = np.repeat(accepted, [g.stop - g.start for g in groups])
    mean, S, C = moments(sensor, x, P)
    S = (S + np.diag(R))[np.ix_(keep, keep)]
    K = np.linalg.solve(S, C[:, keep].T).T
    new_x = x + K @ sensor.residual(z, mean, x)[keep]
    if moments is tangent:
        A = np.eye(len(x)) - K @ sensor.jacobian(x)[keep]
        new_P = A @ P @ A.T + (K * R[keep]) @ K.T
    else:
        new_P = P - K @ S @ K.T
    return Update(new_x, new_P, nis, accepted, log_likelihood)


def iterated(iterations, sensor, groups, links, x, P, z, R, *gate):
    """Iterated extended Kalman filter (Bell and Cathey 1993, eq. for x_i+1), gated at the prior."""
    nis, accepted, R, log_likelihood = gate_groups(
        tangent, sensor, groups, links, x, P, z, R, *gate
    )
    keep = np.repeat(accepted, [g.stop - g.start for g in groups])
    R, iterate = np.diag(R[keep]), x
    for _ in range(iterations):
        H = sensor.jacobian(iterate)[keep]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        residual = sensor.residual(z, sensor.h(iterate), iterate)[keep]
        iterate = x + K @ (residual - H @ (x - iterate))
    A = np.eye(len(x)) - K @ H
    return Update(iterate, A @ P @ A.T + K @ R @ K.T, nis, accepted, log_likelihood)
