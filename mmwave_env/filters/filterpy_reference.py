"""Modes that run on filterpy's filters: slow, and independent of the filters of this package.

Prediction, sigma points, innovation, gain and covariance are filterpy's; the measurement
function and its Jacobian are written here a second time, in plain numpy, row by row as in
textbooks (no fused azimuths, no latents). Tests, the benchmark and doubting users compare the two
implementations. Run it on floats: ``Engine(filterpy_pipeline(pipeline), ..., on_floats=True)``.

An update works in coordinates relative to the prior mean, dx = x - m and dz = z - h(m): angle
differences stay far from their cut, so filterpy's plain subtraction is right, and no digits
cancel in the CKF's covariance, which filterpy computes from raw second moments.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import (
    CubatureKalmanFilter,
    ExtendedKalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas
from numpy.typing import NDArray
from scipy.stats import chi2

from mmwave_env.filters.gating import ROBUST_ONSET, Gate
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.update import Algorithm, Posterior
from mmwave_env.io.lookup import choose
from mmwave_env.models.measurement import Layout, Measurement
from mmwave_env.models.motion import ProcessNoise
from mmwave_env.numerics.numbers import Array, Mask, Matrix, Vector

Rows = NDArray[np.int64]
_STATES = 7
_AT_REST_MPS = 1e-3  # slower users get the odometry's Jacobian at this speed
_NEAREST_M = 1e-3  # up to this distance the direction to an anchor, or its vertical, is undefined


def transition(dt: float) -> Array:
    """Return F (7, 7) of constant velocity over dt seconds."""
    F = np.eye(_STATES)
    F[:3, 3:6] = dt * np.eye(3)
    return F


def full_noise(noise: ProcessNoise) -> Array:
    """Return Q (7, 7), given its non-zero entries."""
    Q = np.diag(np.array(noise.diagonal, float))
    for axis, covariance in enumerate(noise.coupling):
        Q[axis, axis + 3] = Q[axis + 3, axis] = covariance
    return Q


def _inverse(length: float) -> float:
    """Return 1 / length, or 0 for a length that gives no direction."""
    return 1.0 / length if length > _NEAREST_M else 0.0


class _Sight:
    """A measurement relative to the prior mean m."""

    def __init__(self, mean: Array, measurement: Measurement) -> None:
        self._mean, self._layout = mean, measurement.layout
        self._anchors = np.array(measurement.anchors, float)
        self._hz_per_mps = float(measurement.hz_per_mps)
        self._at_mean, self._silent = self._measure(mean), self._without_direction()
        self.innovation = self._difference(np.array(measurement.z, float))
        self.variance = np.array(measurement.variance, float)

    def change(self, dx: Array) -> Array:
        """Return h(m + dx) - h(m)."""
        return self._difference(self._measure(self._mean + dx))

    def _difference(self, z: Array) -> Array:
        """Return z - h(m), angles in [-pi, pi]; 0 in rows whose direction is undefined at m."""
        dz = np.where(self._silent, 0.0, z - self._at_mean)
        angles = self._layout.angles
        dz[angles] = np.remainder(dz[angles] + np.pi, 2.0 * np.pi) - np.pi
        return dz

    def _measure(self, x: Array) -> Array:
        """Return h(x), the measurement without noise (paper, Sec. II-B), in m, rad, Hz and m/s."""
        d = x[:3] - self._anchors
        distance = np.linalg.norm(d, axis=1)
        azimuth = np.arctan2(d[:, 1], d[:, 0])
        elevation = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1]))
        links = np.column_stack([distance, azimuth, elevation, azimuth + np.pi])
        doppler = self._hz_per_mps * (x[3:6] @ d[0]) / max(distance[0], _NEAREST_M) + x[6]
        rows = [*links.ravel(), doppler]
        if self._layout.odometry:
            rows += [np.linalg.norm(x[3:6]), np.arctan2(x[4], x[3])]
        return np.array(rows)

    def _without_direction(self) -> Mask:
        """Return which rows (rows,) are directions undefined at m, which carry no information."""
        d = self._mean[:3] - self._anchors
        vertical = np.hypot(d[:, 0], d[:, 1]) <= _NEAREST_M
        there = np.linalg.norm(d, axis=1) <= _NEAREST_M
        links = np.column_stack([np.zeros_like(there), vertical, there, vertical])
        return np.array([*links.ravel(), there[0], *[False] * 2 * self._layout.odometry])

    def jacobian(self) -> Array:
        """Return the Jacobian H = dh/dx (rows, 7) at m."""
        d, v = self._mean[:3] - self._anchors, self._mean[3:6]
        links = np.zeros((len(d), 4, _STATES))
        for rows, (dx, dy, dz) in zip(links, d, strict=True):
            horizontal, distance = np.hypot(dx, dy), np.sqrt(dx**2 + dy**2 + dz**2)
            inverse_horizontal, inverse = _inverse(horizontal), _inverse(distance)
            rows[0, :3] = np.array([dx, dy, dz]) * inverse
            rows[1, :2] = rows[3, :2] = np.array([-dy, dx]) * inverse_horizontal**2
            rows[2, :2] = np.array([-dx, -dy]) * (dz * inverse_horizontal * inverse**2)
            rows[2, 2] = horizontal * inverse**2
        doppler = np.zeros((1, _STATES))
        inverse = _inverse(float(np.linalg.norm(d[0])))
        doppler[0, :3] = self._hz_per_mps * (v * inverse - (v @ d[0]) * d[0] * inverse**3)
        doppler[0, 3:6] = self._hz_per_mps * d[0] * inverse
        doppler[0, 6] = inverse > 0.0
        H = [*links.reshape(-1, _STATES), *doppler]
        if self._layout.odometry:
            speed_row, heading_row = np.zeros(_STATES), np.zeros(_STATES)
            speed_row[3:6] = v / max(float(np.linalg.norm(v)), _AT_REST_MPS)
            slowest = max(np.hypot(v[0], v[1]), _AT_REST_MPS)
            heading_row[3:5] = np.array([-v[1], v[0]]) / slowest**2
            H += [speed_row, heading_row]
        return np.array(H)


class _Filtered(NamedTuple):
    """The result of a filterpy filter's update: step of the mean, covariance, y and S."""

    step: Array
    P: Array
    y: Array
    S: Array


class _Ekf:
    """The EKF of filterpy; as in all three classes, ``predict`` computes F x and F P F' + Q.

    ``update`` conditions N(0, P) on the chosen rows, with their noise covariance R.
    """

    def __init__(self) -> None:
        self._filter: Any = ExtendedKalmanFilter(_STATES, 1)

    def predict(self, x: Array, P: Array, Q: Array, dt: float) -> tuple[Array, Array]:
        f = self._filter
        f.x, f.P, f.F, f.Q = x, P, transition(dt), Q
        f.predict()
        return f.x, f.P

    def update(self, P: Array, sight: _Sight, rows: Rows, R: Array) -> _Filtered:
        f = self._filter
        f.x, f.P = np.zeros(_STATES), P
        f.update(
            sight.innovation[rows],
            HJacobian=lambda _: sight.jacobian()[rows],
            Hx=lambda dx: sight.change(dx)[rows],
            R=R,
        )
        return _Filtered(f.x, f.P, f.y, f.S)


class _Ukf:
    def __init__(self) -> None:
        self._points: Any = MerweScaledSigmaPoints(_STATES, alpha=1.0, beta=2.0, kappa=0.0)
        self._filter: Any = UnscentedKalmanFilter(_STATES, 1, 1.0, None, None, self._points)

    def predict(self, x: Array, P: Array, Q: Array, dt: float) -> tuple[Array, Array]:
        f, F = self._filter, transition(dt)
        f.x, f.P, f.Q = np.zeros(_STATES), P, Q
        f.predict(fx=lambda dx, _: F @ (x + dx) - x)
        return x + f.x, f.P

    def update(self, P: Array, sight: _Sight, rows: Rows, R: Array) -> _Filtered:
        f = self._filter
        f.x, f.P = np.zeros(_STATES), P
        f.sigmas_f = self._points.sigma_points(f.x, P)
        f.update(sight.innovation[rows], R=R, hx=lambda dx: sight.change(dx)[rows])
        return _Filtered(f.x, f.P, f.y, f.S)


class _Ckf:
    """The CKF of filterpy, which needs columns, a fixed number of rows and points of its caller."""

    def __init__(self) -> None:
        self._filter: Any = CubatureKalmanFilter(_STATES, 1, 1.0, None, None)

    def predict(self, x: Array, P: Array, Q: Array, dt: float) -> tuple[Array, Array]:
        f, F = self._filter, transition(dt)
        f.x, f.P, f.Q = np.zeros((_STATES, 1)), P, Q
        f.fx = lambda dx, _: F @ (x + dx) - x
        f.predict()
        return x + f.x.ravel(), f.P

    def update(self, P: Array, sight: _Sight, rows: Rows, R: Array) -> _Filtered:
        f = self._filter
        f.x, f.P = np.zeros((_STATES, 1)), P
        f.sigmas_f = spherical_radial_sigmas(f.x, P)
        f.sigmas_h = np.zeros((2 * _STATES, len(R)))
        f.hx = lambda dx: sight.change(dx)[rows]
        f.update(sight.innovation[rows, None], R=R)
        return _Filtered(f.x.ravel(), f.P, f.y.ravel(), f.S)


_Filter = _Ekf | _Ukf | _Ckf
_FILTERS: dict[str, Callable[[], _Filter]] = {"ekf": _Ekf, "ukf": _Ukf, "ckf": _Ckf}


def filterpy_pipeline(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline with filterpy's filters in place of this package's.

    Raises:
        ValueError: filterpy's filters cannot run the pipeline: it has flat terrain (the filters
            need a covariance of full rank), or algorithms of the user.
    """
    if pipeline.planar:
        raise ValueError(
            "planar: found True, but filterpy's filters need a covariance of full rank; use "
            "planar=False or this package's own filters"
        )
    # One filter per algorithm; its state is set anew for every step.
    filters = {mode.algorithm: _filter_of(mode) for mode in pipeline.modes}

    def predict(
        mode: Mode, x: Vector, P: Matrix, noise: ProcessNoise, dt: float
    ) -> tuple[list[float], list[list[float]]]:
        mean, covariance = filters[mode.algorithm].predict(
            np.array(x, float), np.array(P, float), full_noise(noise), float(dt)
        )
        return mean.tolist(), _symmetric(covariance).tolist()

    def update(mode: Mode) -> Algorithm:
        return partial(_update, filters[mode.algorithm])

    return replace(pipeline, predict=predict, update=update)


def _filter_of(mode: Mode) -> _Filter:
    name: Any = mode.algorithm  # a function is refused like an unknown name
    return choose(_FILTERS, name, f"algorithm of mode {mode.name!r} on filterpy")()


def _update(
    filter_: _Filter, mean: Vector, covariance: Matrix, measurement: Measurement, gate: Gate
) -> Posterior:
    """Update with every visible group; if a gate rejects a group, again with the accepted ones."""
    x, P = np.array(mean, float), np.array(covariance, float)
    layout, sight = measurement.layout, _Sight(x, measurement)
    R = np.diag(sight.variance)
    everything = np.arange(layout.size)
    visible = [g for g in range(len(layout.groups)) if measurement.visible[g] > 0.5]
    nis, accepted = [0.0] * len(layout.groups), [0.0] * len(layout.groups)
    if not visible:
        return Posterior(x.tolist(), P.tolist(), nis, accepted, 0.0)
    rows = np.concatenate([everything[layout.groups[g]] for g in visible])
    posterior = filter_.update(P, sight, rows, R[np.ix_(rows, rows)])
    log_likelihood, first, doubted = 0.0, 0, False
    for g in visible:
        group = layout.groups[g]
        seen = slice(first, first := first + layout.widths[g])
        y, S = posterior.y[seen], posterior.S[seen, seen]
        nis[g] = float(y @ np.linalg.solve(S, y))
        accepted[g] = float(_passes(nis[g], g, layout, gate))
        log_likelihood -= 0.5 * (nis[g] + float(np.linalg.slogdet(S)[1]))
        if gate.robust and g < layout.anchors and nis[g] > ROBUST_ONSET * len(y):
            doubted = True
            R[group, group] *= (nis[g] / (ROBUST_ONSET * len(y))) ** 2
    kept = [g for g in visible if accepted[g]]
    if not kept:
        return Posterior(x.tolist(), P.tolist(), nis, accepted, log_likelihood)
    if doubted or kept != visible:
        rows = np.concatenate([everything[layout.groups[g]] for g in kept])
        posterior = filter_.update(P, sight, rows, R[np.ix_(rows, rows)])
    x, P = x + posterior.step, _symmetric(posterior.P)
    return Posterior(x.tolist(), P.tolist(), nis, accepted, log_likelihood)


def _passes(nis: float, g: int, layout: Layout, gate: Gate) -> bool:
    """Tell whether a visible group is used."""
    is_link = g < layout.anchors
    if gate.quantile is None or (is_link and (gate.robust or gate.force > 0.5)):
        return True
    return nis <= _threshold(gate.quantile, layout.widths[g])


@cache
def _threshold(quantile: float, rows: int) -> float:
    return float(chi2.ppf(quantile, rows))


def _symmetric(P: Array) -> Array:
    """Return P without the asymmetry due to rounding."""
    return 0.5 * (P + P.T)  # type: ignore[no-any-return]
