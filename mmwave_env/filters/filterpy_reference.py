"""Modes that run on filterpy's filters: slow, and independent of the filters of this package.

Prediction, sigma points, innovation, gain and covariance come from filterpy; the measurement
function and its Jacobian come from :class:`~mmwave_env.filters.textbook.Sensor`, row by row,
without this package's shortcuts, such as latent variables. The tests compare the two
implementations, and so can you if you doubt a result. To run such modes, use
``Engine(filterpy_pipeline(...), on_floats=True)``.

An update works in coordinates relative to the prior mean m: dx = x - m and dz = z - h(m). Small
values are needed for two reasons: filterpy subtracts angles without wrapping them, and it computes
the CKF's covariance from raw second moments, where large values would cancel and lose digits.
"""

from collections.abc import Callable
from functools import cache, partial
from threading import get_ident
from typing import Any

import numpy as np
from filterpy.kalman import (
    CubatureKalmanFilter,
    ExtendedKalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas

from mmwave_env.filters import textbook
from mmwave_env.filters.gating import ROBUST_ONSET, Gate, passes
from mmwave_env.filters.modes import ALGORITHMS, Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.update import Algorithm, Posterior
from mmwave_env.io.lookup import choose
from mmwave_env.models.measurement import Measurement
from mmwave_env.models.motion import COUPLED, ProcessNoise
from mmwave_env.numerics.numbers import Array, Index, Matrix, Vector


class _Relative:
    """The differences z - h(m) and h(m + dx) - h(m) of a measurement z at the prior mean m."""

    def __init__(self, mean: Array, measurement: Measurement) -> None:
        layout = measurement.layout
        anchors = np.array(measurement.anchors, float)
        shifted = int(np.argmax(measurement.doppler_of)) if len(measurement.doppler_of) else 0
        self._sensor = textbook.Sensor(
            anchors, float(measurement.hz_per_mps), layout.odometry, shifted, layout.has_bias
        )
        self._mean = mean
        self._at_mean = self._sensor.h(mean)
        self.innovation = self._difference(np.array(measurement.z, float))

    def change(self, dx: Array) -> Array:
        """Return h(m + dx) - h(m)."""
        return self._difference(self._sensor.h(self._mean + dx))

    def _difference(self, z: Array) -> Array:
        return self._sensor.residual(z, self._at_mean, self._mean)

    def jacobian(self) -> Array:
        """Return H = dh/dx (rows, 7) at m; 0 where it is undefined, as for odometry at rest."""
        with np.errstate(invalid="ignore"):
            return np.nan_to_num(self._sensor.jacobian(self._mean))


class _Ekf:
    """The EKF of filterpy. In this and the following class, ``predict`` computes F x, F P F' + Q.

    ``update`` conditions N(0, P) on the chosen rows, whose noise covariance is R. It returns
    filterpy's filter, with the step x of the mean, P, the innovation y and its covariance S.
    """

    def __init__(self, size: int) -> None:
        self._filter: Any = ExtendedKalmanFilter(size, 1)

    def predict(self, x: Array, P: Array, Q: Array, F: Array) -> tuple[Array, Array]:
        f = self._filter
        f.x = x
        f.P = P
        f.F = F
        f.Q = Q
        f.predict()
        return f.x, f.P

    def update(self, P: Array, relative: _Relative, rows: Index, R: Array) -> Any:
        f = self._filter
        f.x = np.zeros(len(P))
        f.P = P
        f.update(
            relative.innovation[rows],
            HJacobian=lambda _: relative.jacobian()[rows],
            Hx=lambda dx: relative.change(dx)[rows],
            R=R,
        )
        return f


class _PointFilter:
    """A filter of filterpy with sigma points, which are relative to the mean.

    ``points`` returns the sigma points of a mean and a covariance. filterpy's CKF needs column
    vectors, which its mean is from the beginning.
    """

    def __init__(self, filter_: Any, points: Callable[[Array, Array], Array]) -> None:
        self._filter = filter_
        self._points = points

    def predict(self, x: Array, P: Array, Q: Array, F: Array) -> tuple[Array, Array]:
        f = self._filter
        f.x = np.zeros_like(f.x)
        f.P = P
        f.Q = Q
        f.fx = lambda dx, _: F @ (x + dx) - x
        f.predict()
        return x + f.x.ravel(), f.P

    def update(self, P: Array, relative: _Relative, rows: Index, R: Array) -> Any:
        f = self._filter
        f.x = np.zeros_like(f.x)
        f.P = P
        f.sigmas_f = self._points(f.x, P)
        f.sigmas_h = np.zeros((len(f.sigmas_f), len(R)))
        f.hx = lambda dx: relative.change(dx)[rows]
        f.update(relative.innovation[rows].reshape(-1, *f.x.shape[1:]), R=R)
        return f


_Filter = _Ekf | _PointFilter


@cache
def _filter_of(algorithm: str, size: int, thread: int) -> _Filter:
    """Return the filter that all modes with this algorithm and size of the state share.

    Every call of filterpy sets the whole state of a filter, so only threads need their own.
    """
    if algorithm == "ekf":
        return _Ekf(size)
    if algorithm == "ckf":
        ckf = CubatureKalmanFilter(size, 1, 1.0, None, None)
        return _PointFilter(ckf, spherical_radial_sigmas)
    points: Any = MerweScaledSigmaPoints(size, alpha=1.0, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(size, 1, 1.0, None, None, points)
    return _PointFilter(ukf, points.sigma_points)


class FilterpyPipeline(Pipeline):
    """A pipeline whose modes predict and update with filterpy's filters."""

    def predict(
        self,
        mode: Mode,
        x: Vector,
        P: Matrix,
        noise: ProcessNoise,
        dt: float,
        hz_per_mps: float | None,
    ) -> tuple[list[float], list[list[float]]]:
        """Return filterpy's prediction."""
        Q = np.diag(np.array(noise.diagonal, float))
        for (i, j), value in zip(COUPLED, noise.coupling, strict=False):
            Q[i, j] = Q[j, i] = value
        drive = None if hz_per_mps is None else float(hz_per_mps)
        F = textbook.F(float(dt), len(x), drive)
        filter_ = _filter_of(str(mode.algorithm), len(x), get_ident())
        mean, covariance = filter_.predict(np.array(x, float), np.array(P, float), Q, F)
        return mean.tolist(), _symmetric(covariance).tolist()

    def update(self, mode: Mode) -> Algorithm:
        """Return filterpy's measurement update of a mode."""
        size = self.layout.state_size
        return partial(_update, _filter_of(str(mode.algorithm), size, get_ident()))


def filterpy_pipeline(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline with filterpy's filters instead of this package's.

    Raises:
        ValueError: filterpy cannot run the pipeline, because it is planar (filterpy needs a
            covariance of full rank) or the algorithm of a mode is a user's function.
    """
    if pipeline.planar:
        raise ValueError(
            "planar: found True, but filterpy's filters need a covariance of full rank; use "
            "planar=False or this package's own filters"
        )
    for mode in pipeline.modes:
        name: Any = mode.algorithm  # a user's function is refused like an unknown name
        choose(ALGORITHMS, name, f"algorithm of mode {mode.name!r} on filterpy")
    return FilterpyPipeline(**vars(pipeline))


def _update(
    filter_: _Filter,
    mean: Vector,
    covariance: Matrix,
    measurement: Measurement,
    gate: Gate,
) -> Posterior:
    """Update with all visible groups; update again if gates reject groups or inflate noise."""
    x = np.array(mean, float)
    P = np.array(covariance, float)
    layout = measurement.layout
    relative = _Relative(x, measurement)
    R = np.diag(np.array(measurement.variance, float))
    measured = measurement.measured if layout.partial else [1.0] * layout.size
    groups = [
        np.arange(layout.size)[rows][np.array(measured[rows]) > 0.5] for rows in layout.groups
    ]
    nis = [0.0] * len(layout.groups)
    accepted = list(measurement.visible)  # also a range that a free clock has used up
    visible = [g for g, rows in enumerate(groups) if measurement.visible[g] > 0.5 and len(rows)]
    log_likelihood = 0.0

    def conditioned(chosen: list[int]) -> Any:
        rows = np.concatenate([groups[g] for g in chosen])
        return filter_.update(P, relative, rows, R[np.ix_(rows, rows)])

    posterior: Any = conditioned(visible) if visible else None
    first = 0
    doubted = False
    for g in visible:
        part = slice(first, first := first + len(groups[g]))
        y = posterior.y.ravel()[part]
        S = posterior.S[part, part]
        nis[g] = float(y @ np.linalg.solve(S, y))
        lenient = g < layout.anchors and (gate.robust or gate.force > 0.5)
        accepted[g] = 1.0 if lenient else passes(nis[g], len(y), gate.quantile)
        log_likelihood -= 0.5 * (nis[g] + float(np.linalg.slogdet(S)[1]))
        if gate.robust and g < layout.anchors and nis[g] > ROBUST_ONSET * len(y):
            doubted = True
            R[np.ix_(groups[g], groups[g])] *= (nis[g] / (ROBUST_ONSET * len(y))) ** 2
    kept = [g for g in visible if accepted[g]]
    if kept and (doubted or kept != visible):
        posterior = conditioned(kept)
    if kept:
        x = x + posterior.x.ravel()
        P = _symmetric(posterior.P)
    return Posterior(x.tolist(), P.tolist(), nis, accepted, log_likelihood)


def _symmetric(P: Array) -> Array:
    """Return P without the asymmetry due to rounding."""
    return 0.5 * (P + P.T)  # type: ignore[no-any-return]
