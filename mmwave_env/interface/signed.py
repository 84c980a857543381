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
# maximum share of a link, in standard deviations, in the mean residual of all links; without a
# limit, a false path would count for more than a turned frame
_MOST_SHARE = 1.5
_ROWS = {"range": 0, "azimuth": 1, "elevation": 2, "departure": 3}  # index within a link's rows


class LastEpoch(NamedTuple):
    """The epoch that was filtered last; features describe the belief after its update."""

    epoch: Epoch
    is_missing: Number  # 1 if no epoch has been filtered yet, else 0
    velocity: Vector  # (3,) velocity of the belief before the epoch
    probabilities: Vector  # (modes,) probabilities after the update; empty with a shared belief


def after_update(pipeline: Pipeline) -> list[Feature]:
    """Return all features that use only the last epoch, for policies that correct beliefs.

    Every mode keeps its own belief.
    """
    return [*last_epoch(pipeline.layout), *signed(pipeline, per_mode=True)]


def signed(pipeline: Pipeline, per_mode: bool) -> list[Feature]:
    """Return the signed features; their ``View`` must have a :class:`LastEpoch`.

    Args:
        pipeline: modes and layout.
        per_mode: whether every mode keeps its own belief, so that modes have probabilities.
    """
    modes = pipeline.modes if per_mode else ()
    return [
        *(part for a in range(pipeline.layout.anchors) for part in _link(a)),
        *(feature(f"mean {name} residual", partial(_mean_residual, name)) for name in _ROWS),
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
    return _present(view) * log(1.0 + view.last.epoch.doppler_spread_hz / view.site.hz_per_mps)


def _measured(view: View, anchor: int, row: int) -> Number:
    """Return 1 if a row of a link was measured in the last epoch, else 0."""
    epoch = view.last.epoch
    here = epoch.measured[4 * anchor + row] if view.layout.partial else epoch.visible[anchor]
    return here * _present(view)


def _squashed(q: Number) -> Number:
    """Compute sign(q) ln(1 + |q|)."""
    size = log(1.0 + abs(q))
    return where(q < 0.0, 0.0 - size, size)


class _Residual(NamedTuple):
    """The residual of a row of a link, from the belief after the update."""

    value: Number  # m at the user; rad for an elevation
    deviation: Number  # standard deviation of the measurement, in the same unit
    toward: Pair  # horizontal direction in which a positive residual moves the user
    deviation_m: Number  # standard deviation of the measurement, m at the user


def _residual(view: View, anchor: int, name: str) -> _Residual:
    step = minus(view.x, view.site.anchors[anchor])
    flat = norms(step)[0]
    distance, azimuth, elevation = direction(step)
    row = 4 * anchor + _ROWS[name]
    sigma = view.last.epoch.sigma[row]
    z = view.last.epoch.z[row]
    scale = 1.0 / maximum(flat, 1.0)
    ux = step[0] * scale
    uy = step[1] * scale
    if name == "elevation":
        deviation = maximum(sigma, _LEAST_RAD)
        in_meters = maximum(sigma * distance, _LEAST_M)
        return _Residual(wrap(z - elevation), deviation, (0.0, 0.0), in_meters)
    if name == "range":
        value = z - distance - (view.x[7] if view.layout.has_bias else 0.0)
        deviation = maximum(sigma, _LEAST_M)
        return _Residual(value, deviation, (ux, uy), deviation)
    opposite = PI if name == "departure" else 0.0
    deviation = maximum(sigma * flat, _LEAST_M)
    value = _turned(z - azimuth - opposite) * flat
    return _Residual(value, deviation, (0.0 - uy, ux), deviation)


def _row(view: View, anchor: int, name: str) -> tuple[Number, Number, Number]:
    """Return two components of a row's residual, and ln of its deviation in meters at the user.

    The residual, :func:`_squashed`, has components along and across the velocity; that of an
    elevation has only one, and the second is 0. All numbers are 0 if the row was not measured.
    """
    measured = _measured(view, anchor, _ROWS[name])
    row = _residual(view, anchor, name)
    q = _squashed(row.value / row.deviation) * measured
    size = log(row.deviation_m) * measured
    if name == "elevation":
        return q, 0.0, size
    along, across = Frame.of(view.x[3:5]).into(*row.toward)
    return q * along, q * across, size


def _mean_residual(name: str, view: View) -> Number:
    """Return the mean residual of a row over the links that measured it, in standard deviations.

    Errors that all links share, such as a turned frame or a clock that is ahead, give it the same
    sign in many epochs.
    """
    total: Number = 0.0
    count: Number = 0.0
    for anchor in range(view.layout.anchors):
        measured = _measured(view, anchor, _ROWS[name])
        row = _residual(view, anchor, name)
        share = maximum(minimum(row.value / row.deviation, _MOST_SHARE), -_MOST_SHARE)
        total = total + share * measured
        count = count + measured
    return total / maximum(count, 1.0)


def _turned(angle: Number) -> Number:
    """Wrap an angle, which must be between -5 pi and 3 pi, to [-pi, pi]."""
    return wrap(where(angle < -PI, angle + 2.0 * PI, angle))


def _link(a: int) -> list[Feature]:
    def share(v: View) -> Number:
        return 0.25 * sum(_measured(v, a, row) for row in range(4))

    def part(name: str, i: int, v: View) -> Number:
        return _row(v, a, name)[i]

    def snr(v: View) -> Number:
        return v.last.epoch.snr_db[a] * v.last.epoch.visible[a] * _present(v)

    anchor = f"anchor {a + 1}"
    table = []
    for name in ("range", "azimuth", "departure"):
        kinds = (*(f"{name} residual {way}" for way in WAYS), f"{name} deviation")
        table += [feature(kind, partial(part, name, i), anchor) for i, kind in enumerate(kinds)]
    return [
        *table,
        feature("elevation residual", partial(part, "elevation", 0), anchor),
        feature("elevation deviation", partial(part, "elevation", 2), anchor),
        feature("measured", share, anchor),
        feature("last SNR", snr, anchor),
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
            feature(f"{prefix}deviation {way}", partial(half_log, i, first))
            for prefix, first in (("", 0), ("velocity ", 3))
            for i, way in enumerate(WAYS)
        ),
        feature("correlation", correlation),
    ]
    if vertical:
        table.append(feature("deviation up", lambda v: 0.5 * log(maximum(v.P[2][2], 1e-12))))
    return table
