"""Signed features: residuals and belief after an epoch's update, relative to the user's motion.

Directions refer to the *frame of motion*: along the estimated horizontal velocity, across it
(to the left) and up. No feature depends on an absolute position or direction: if the world is
turned and shifted, the features stay the same. So a network that learns from them in one street
also works in another. All features describe the last epoch; none depends on the coming epoch.
"""

from functools import partial
from typing import NamedTuple

from mmwave_env.filters.correction import Frame
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.features import WAYS, Feature, View, feature, last_epoch
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, direction, norms
from mmwave_env.numerics.linalg import dot, minus
from mmwave_env.numerics.numbers import (
    PI,
    Number,
    Pair,
    Vector,
    log,
    maximum,
    minimum,
    sqrt,
    where,
    wrap,
)

_LEAST_M = 0.05  # minimum standard deviation by which residuals are divided, m
_LEAST_RAD = 1e-3  # minimum standard deviation by which elevation residuals are divided, rad
_LEAST_S = 1e-3  # minimum time between epochs in a logarithm, s
_ROWS = {"range": 0, "azimuth": 1, "elevation": 2, "departure": 3}  # index within a link's rows


class LastEpoch(NamedTuple):
    """The epoch that was filtered last; features describe the belief after its update."""

    epoch: Epoch
    is_missing: Number  # 1 if no epoch has been filtered yet, else 0
    velocity: Vector  # (3,) velocity of the belief before the epoch
    probabilities: Vector  # (modes,) probabilities after the update; empty with a shared belief


def after_update(pipeline: Pipeline, per_mode: bool = False) -> list[Feature]:
    """Return all features that use only the last epoch, for policies that correct beliefs."""
    return [*last_epoch(pipeline.layout), *signed(pipeline, per_mode)]


def signed(pipeline: Pipeline, per_mode: bool = False) -> list[Feature]:
    """Return the signed features; their ``View`` must have a :class:`LastEpoch`.

    Args:
        pipeline: modes and layout.
        per_mode: whether every mode keeps its own belief, so that modes have probabilities.
    """
    modes = pipeline.modes if per_mode else ()
    return [
        *(part for a in range(pipeline.layout.anchors) for part in _link(pipeline.layout, a)),
        *_belief(2 not in pipeline.known_axes),
        feature("turn sine", lambda v: _turn(v)[1]),
        feature("turn cosine", lambda v: _turn(v)[0]),
        feature("last step", _step),
        feature("last speed", lambda v: log(1.0 + sqrt(dot(v.x[3:5], v.x[3:5])))),
        feature("last Doppler spread", _spread),
        *(
            feature("probability", lambda v, m=m: v.last.probabilities[m], mode.name)
            for m, mode in enumerate(modes)
        ),
    ]


def _present(view: View) -> Number:
    return 1.0 - view.last.is_missing


def _turn(view: View) -> Pair:
    cosine, sine = Frame.of(view.last.velocity).into(*Frame.of(view.x[3:5]))
    present = _present(view)
    return 1.0 - present * (1.0 - cosine), present * sine


def _step(view: View) -> Number:
    dt = view.last.epoch.dt
    return where(dt * _present(view) > 0.0, log(maximum(dt, _LEAST_S)), 0.0)


def _spread(view: View) -> Number:
    present = _present(view)
    return present * log(1.0 + view.last.epoch.doppler_spread_hz / view.site.hz_per_mps)


def _measured(view: View, layout: Layout, anchor: int, row: int) -> Number:
    """Return 1 if a row of a link was measured in the last epoch, else 0."""
    epoch = view.last.epoch
    here = epoch.measured[4 * anchor + row] if layout.partial else epoch.visible[anchor]
    return here * _present(view)


def _squashed(q: Number) -> Number:
    """Compute sign(q) ln(1 + |q|)."""
    size = log(1.0 + abs(q))
    return where(q < 0.0, 0.0 - size, size)


def _row(view: View, layout: Layout, anchor: int, name: str) -> tuple[Number, Number, Number]:
    """Return two components of a row's residual, and ln of its deviation in meters at the user.

    The residual, :func:`_squashed`, has components along and across the velocity; that of an
    elevation has only one, and the second is 0. All numbers are 0 if the row was not measured.
    """
    step = minus(view.x, view.site.anchors[anchor])
    flat = norms(step)[0]
    distance, azimuth, elevation = direction(step)
    row = 4 * anchor + _ROWS[name]
    sigma = view.last.epoch.sigma[row]
    z = view.last.epoch.z[row]
    measured = _measured(view, layout, anchor, _ROWS[name])
    scale = 1.0 / maximum(flat, 1.0)
    ux = step[0] * scale
    uy = step[1] * scale
    if name == "elevation":
        q = _squashed(wrap(z - elevation) / maximum(sigma, _LEAST_RAD)) * measured
        return q, 0.0, log(maximum(sigma * distance, _LEAST_M)) * measured
    if name == "range":
        residual = z - distance - (view.x[7] if layout.has_bias else 0.0)
        deviation = maximum(sigma, _LEAST_M)
        toward = (ux, uy)
    else:
        opposite = PI if name == "departure" else 0.0
        residual = _turned(z - azimuth - opposite) * flat
        deviation = maximum(sigma * flat, _LEAST_M)
        toward = (0.0 - uy, ux)
    q = _squashed(residual / deviation) * measured
    along, across = Frame.of(view.x[3:5]).into(*toward)
    return q * along, q * across, log(deviation) * measured


def _turned(angle: Number) -> Number:
    """Wrap an angle, which must be between -5 pi and 3 pi, to [-pi, pi]."""
    return wrap(where(angle < -PI, angle + 2.0 * PI, angle))


def _link(layout: Layout, a: int) -> list[Feature]:
    def share(v: View) -> Number:
        return 0.25 * sum(_measured(v, layout, a, row) for row in range(4))

    def part(name: str, i: int, v: View) -> Number:
        return _row(v, layout, a, name)[i]

    def snr(v: View) -> Number:
        return v.last.epoch.snr_db[a] * v.last.epoch.visible[a] * _present(v)

    of = f"anchor {a + 1}"
    table = []
    for name in ("range", "azimuth", "departure"):
        kinds = (*(f"{name} residual {way}" for way in WAYS), f"{name} deviation")
        table += [feature(kind, partial(part, name, i), of) for i, kind in enumerate(kinds)]
    return [
        *table,
        feature("elevation residual", partial(part, "elevation", 0), of),
        feature("elevation deviation", partial(part, "elevation", 2), of),
        feature("measured", share, of),
        feature("last SNR", snr, of),
    ]


def _belief(vertical: bool) -> list[Feature]:
    def half_log(part: int, first: int, v: View) -> Number:
        variance = Frame.of(v.x[3:5]).covariance(v.P, first)[part]
        return 0.5 * log(maximum(variance, 1e-12))

    def correlation(v: View) -> Number:
        along, across, both = Frame.of(v.x[3:5]).covariance(v.P)
        return maximum(minimum(both / sqrt(maximum(along * across, 1e-24)), 1.0), -1.0)

    table = [
        *(
            feature(f"{of}deviation {way}", partial(half_log, i, first))
            for of, first in (("", 0), ("velocity ", 3))
            for i, way in enumerate(WAYS)
        ),
        feature("correlation", correlation),
    ]
    if vertical:
        table.append(feature("deviation up", lambda v: 0.5 * log(maximum(v.P[2][2], 1e-12))))
    return table
