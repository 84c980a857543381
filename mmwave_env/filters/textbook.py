"""Textbook Kalman filters in plain numpy; an update processes all rows of a measurement together.

Read this file first. The filters that run (:mod:`~mmwave_env.filters.update`,
:mod:`~mmwave_env.filters.imm`, :mod:`~mmwave_env.filters.smoother`) compute the same values in
forms that compile to SIMD lanes, and tests compare them with this file. Equation numbers are the
paper's (Sec. III); the IMM is from Bar-Shalom, Li and Kirubarajan 2001, 11.6.6.

The state x (7,) is position (m), velocity (m/s) and oscillator bias (Hz). A measurement z has four
rows for each anchor: range (m), azimuth and elevation of arrival (rad), azimuth of departure (rad).
The last rows are the Doppler shift of one anchor (Hz) and, optionally, speed (m/s) and heading
(rad). If the user's clock is not synchronized, its range bias (m) is an eighth state component.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mmwave_env.numerics.numbers import Array, Mask

NEAREST_M = 1e-3  # angles are undefined this near an anchor or the vertical line through it


def F(dt: float, n: int = 7, hz_per_mps: float | None = None) -> Array:
    """Return the constant-velocity transition matrix over dt seconds: eqs. (2) and (3).

    With n = 8, the state includes the range bias of the user's clock. The oscillator's bias drives
    it (Groves 2013, Sec. 9.4.2), if ``hz_per_mps``, f_c / c, is given. Otherwise the clock is free:
    the new range bias does not depend on the state, and has a large variance in Q.
    """
    if n == 7:
        return np.eye(7) + dt * np.eye(7, k=3) * (np.arange(7) < 3)[:, None]
    transition = np.zeros((8, 8))
    transition[:7, :7] = F(dt)
    if hz_per_mps is not None:
        transition[7, 6:] = dt / hz_per_mps, 1.0
    return transition


def predict(
    x: Array, P: Array, Q: Array, dt: float, hz_per_mps: float | None = None
) -> tuple[Array, Array]:
    """Predict the belief: F x, F P F' + Q, eqs. (10) to (12)."""
    transition = F(dt, len(x), hz_per_mps)
    return transition @ x, transition @ P @ transition.T + Q


class Moments(NamedTuple):
    """Moments of the measurement that a belief predicts, without the measurement noise."""

    mean: Array  # (rows,)
    S: Array  # (rows, rows) covariance of the measurement
    C: Array  # (7, rows) covariance of the state with the measurement


Method = Callable[["Sensor", Array, Array], Moments]


def tangent(model: "Sensor", x: Array, P: Array) -> Moments:
    """Linearize at the mean: the extended Kalman filter, eqs. (13) to (15)."""
    H = model.jacobian(x)
    return Moments(model.h(x), H @ P @ H.T, P @ H.T)


def unscented(alpha: float, beta: float, kappa: float) -> Method:
    """Return the scaled unscented transform (van der Merwe 2004): the UKF, eq. (16)."""

    def moments(model: "Sensor", x: Array, P: Array) -> Moments:
        n = len(x)
        scale = alpha**2 * (n + kappa)
        columns = np.linalg.cholesky(scale * P).T
        points = np.vstack([x, x + columns, x - columns])
        mean_weights = np.full(2 * n + 1, 0.5 / scale)
        mean_weights[0] = 1.0 - n / scale
        weights = mean_weights.copy()
        weights[0] += 1.0 - alpha**2 + beta
        return _weighted(model, x, points, mean_weights, weights)

    return moments


def cubature(model: "Sensor", x: Array, P: Array) -> Moments:
    """Use the third-degree spherical-radial rule: the CKF (Arasaratnam and Haykin 2009)."""
    n = len(x)
    columns = np.sqrt(n) * np.linalg.cholesky(P).T
    weights = np.full(2 * n, 0.5 / n)
    return _weighted(model, x, np.vstack([x + columns, x - columns]), weights, weights)


def _weighted(
    model: "Sensor", x: Array, points: Array, mean_weights: Array, weights: Array
) -> Moments:
    center = model.h(x)
    relative = np.array([model.residual(model.h(point), center, x) for point in points])
    shift = mean_weights @ relative
    spread = relative - shift
    S = (spread.T * weights) @ spread
    return Moments(center + shift, S, ((points - x).T * weights) @ spread)


METHODS: dict[str, Method] = {"ekf": tangent, "ukf": unscented(1.0, 2.0, 0.0), "ckf": cubature}


def update(
    method: Method, model: "Sensor", x: Array, P: Array, z: Array, R: Array, keep: Mask
) -> tuple[Array, Array]:
    """Condition the belief on the rows to keep: x + K y, K = C S^-1, eqs. (13) to (16).

    A measurement z (rows,) has variances R (rows,); ``keep`` (rows,) is a mask of the rows that
    were measured and passed their gates; the method is one of :data:`METHODS`.
    """
    mean, S, C = method(model, x, P)
    S = (S + np.diag(R))[np.ix_(keep, keep)]
    K = np.linalg.solve(S, C[:, keep].T).T
    updated = x + K @ model.residual(z, mean, x)[keep]
    if method is tangent:  # Joseph's form
        A = np.eye(len(x)) - K @ model.jacobian(x)[keep]
        return updated, A @ P @ A.T + (K * R[keep]) @ K.T
    return updated, P - K @ S @ K.T


def mix(probability: Array, transition: Array, x: Array, P: Array) -> tuple[Array, Array, Array]:
    """Mix the beliefs of M modes before an epoch of an IMM.

    Given the modes' probabilities (M,), transition probabilities (M, M), indexed [from, to], means
    (M, 7) and covariances (M, 7, 7), return predicted probabilities, mixed means and covariances.
    """
    joint = transition * probability[:, None]
    predicted = joint.sum(axis=0)
    weights = joint / predicted
    return predicted, *combine(weights.T, x, P)


def reweigh(predicted: Array, log_likelihood: Array) -> Array:
    """Return the probabilities (M,) of modes after their updates."""
    weights = predicted * np.exp(log_likelihood - log_likelihood.max())
    return np.asarray(weights / weights.sum())


def combine(probability: Array, x: Array, P: Array) -> tuple[Array, Array]:
    """Return mean (..., 7) and covariance (..., 7, 7) of mixtures, such as an IMM's estimate.

    A mixture has M modes with probabilities (..., M), means (..., M, 7) and covariances
    (..., M, 7, 7).
    """
    mean = np.einsum("...m,...mi->...i", probability, x)
    away = x - mean[..., None, :]
    spread = P + away[..., :, None] * away[..., None, :]
    return mean, np.einsum("...m,...mij->...ij", probability, spread)


def rts(
    x: Array,
    P: Array,
    P_predicted: Array,
    time_s: Array,
    free: Sequence[int] = range(7),
    hz_per_mps: float | None = None,
) -> tuple[Array, Array]:
    """Smooth one track with the Rauch-Tung-Striebel smoother: eqs. (17) and (18).

    Args:
        x, P: (T, 7) and (T, 7, 7) filtered beliefs at the times ``time_s`` (T,).
        P_predicted: (T, 7, 7) predicted covariances; the predicted means are F x.
        free: indices of the uncertain components of x; on flat terrain there are five.
        hz_per_mps: same as for :func:`F`.
    """
    filtered = x
    x = x.copy()
    P = P.copy()
    block = np.ix_(free, free)
    for t in reversed(range(len(x) - 1)):
        Ft = F(time_s[t + 1] - time_s[t], x.shape[1], hz_per_mps)
        gain = np.zeros_like(P[t])
        gain[block] = (P[t] @ Ft.T)[block] @ np.linalg.inv(P_predicted[t + 1][block])
        x[t] += gain @ (x[t + 1] - Ft @ filtered[t])
        P[t] += gain @ (P[t + 1] - P_predicted[t + 1]) @ gain.T
    return x, P


@dataclass(frozen=True)
class Sensor:
    """The paper's measurement model: eqs. (5) to (8)."""

    anchors: Array  # (L, 3) positions, m; the first is the base station
    hz_per_mps: float  # f_c / c
    odometry: bool = False  # whether speed and heading are measured, too
    shifted: int = 0  # index, from 0, of the anchor whose Doppler shift is measured
    clock: bool = False  # whether ranges include the range bias of the user's clock

    def h(self, x: Array) -> Array:
        """Return the measurement (rows,) that is expected in a state."""
        z = []
        for anchor in self.anchors:
            east, north, up = x[:3] - anchor
            azimuth = np.arctan2(north, east)
            elevation = np.arctan2(up, np.hypot(east, north))
            distance = np.sqrt(east**2 + north**2 + up**2) + (x[7] if self.clock else 0.0)
            z += [distance, azimuth, elevation, azimuth + np.pi]
        d = x[:3] - self.anchors[self.shifted]
        z.append(self.hz_per_mps * (d @ x[3:6]) / max(np.sqrt(d @ d), NEAREST_M) + x[6])
        if self.odometry:
            z += [np.sqrt(x[3:6] @ x[3:6]), np.arctan2(x[4], x[3])]
        return np.array(z)

    def jacobian(self, x: Array) -> Array:
        """Return H (rows, 7) = dh/dx."""
        H = []
        for anchor in self.anchors:
            d = x[:3] - anchor
            east, north, up = d
            rho = np.sqrt(east**2 + north**2)
            i = _inverse(np.sqrt(d @ d))
            j = _inverse(rho)
            azimuth = [-north * j**2, east * j**2, 0, 0, 0, 0, 0]
            elevation = [-east * up * i**2 * j, -north * up * i**2 * j, rho * i**2, 0, 0, 0, 0]
            H += [[*(d * i), 0, 0, 0, 0], azimuth, elevation, azimuth]
        d = x[:3] - self.anchors[self.shifted]
        v = x[3:6]
        i = _inverse(np.sqrt(d @ d))
        u = d * i
        across = (np.eye(3) - np.outer(u, u)) @ v * i
        H.append([*(self.hz_per_mps * across), *(self.hz_per_mps * u), float(i > 0.0)])
        if self.odometry:
            vx, vy, _ = v
            H.append([0, 0, 0, *(v / np.sqrt(v @ v)), 0])
            H.append([0, 0, 0, -vy / (vx**2 + vy**2), vx / (vx**2 + vy**2), 0, 0])
        if self.clock:
            doppler = 4 * self.links
            return np.column_stack([H, [float(i < doppler and i % 4 == 0) for i in range(len(H))]])
        return np.array(H)

    @property
    def links(self) -> int:
        """Return the number of anchors."""
        return len(self.anchors)

    @property
    def angles(self) -> Mask:
        """Return a mask (rows,) of the rows that are angles."""
        rows = [False, True, True, True] * self.links + [False]
        return np.array([*rows, False, True] if self.odometry else rows)

    def difference(self, a: Array, b: Array) -> Array:
        """Return a - b (rows,), with angles wrapped to [-pi, pi)."""
        wrapped = (a - b + np.pi) % (2 * np.pi) - np.pi
        return np.where(self.angles, wrapped, a - b)

    def residual(self, a: Array, b: Array, x: Array) -> Array:
        """Return a - b (rows,), with angles wrapped, and 0 in rows that are undefined at x."""
        return np.where(self.silent(x), 0.0, self.difference(a, b))

    def silent(self, x: Array) -> Mask:
        """Return a mask (rows,) of the rows that are ignored, because they are undefined at x."""
        d = x[:3] - self.anchors
        on_vertical = np.hypot(d[:, 0], d[:, 1]) <= NEAREST_M
        at_anchor = np.sqrt((d * d).sum(axis=1)) <= NEAREST_M
        never = np.zeros(self.links, bool)
        links = np.column_stack([never, on_vertical, at_anchor, on_vertical])
        rows = [*links.ravel(), at_anchor[self.shifted]]
        return np.array([*rows, False, False] if self.odometry else rows)


def _inverse(length: float) -> float:
    return 1.0 / length if length > NEAREST_M else 0.0
