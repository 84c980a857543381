"""Features of an observation, each with its formula.

An estimator can compute each feature at run time; none uses the truth. The formulas are functions
of plain numbers, so that they can be compiled into the SIMD kernel. Everything else about a feature
depends only on its kind: data/features.json has a row for each kind.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

from mmwave_env.filters.memory import Memory, correction_of
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.update import ModeResult, capped_log_likelihood
from mmwave_env.io.files import Json, shipped_json
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site, doppler_anchor, norms, range_rate
from mmwave_env.models.motion import move
from mmwave_env.numerics.linalg import dot, minus
from mmwave_env.numerics.numbers import Matrix, Number, Vector, log, maximum, sqrt, where

MISSING_SNR_DB = -20.0
UNSEEN = {"SNR": MISSING_SNR_DB}  # value if an anchor is never visible; 0 for other kinds
_LEAST = 1e-9  # lower limit of a probability in a logarithm
WAYS = ("along", "across")  # components of a horizontal vector: along a velocity, to its left


class View(NamedTuple):
    """The inputs of features."""

    # x, P: mean (7,) and covariance (7, 7) of the belief after the last epoch
    x: Vector
    P: Matrix
    memory: Memory  # memory of the track
    candidates: list[ModeResult]  # each mode's result for the coming epoch
    epoch: Epoch  # the coming epoch
    site: Site  # anchors and carrier
    layout: Layout  # which quantity is in which row of a measurement
    # The next three are empty unless each mode has its own belief.
    # predicted, posterior: (modes,) probabilities of modes before and after the coming measurement
    predicted: Vector = ()
    posterior: Vector = ()
    spread_averages_hz: Vector = ()  # moving averages of the Doppler spread, fast to slow
    last: Any = None  # a ``signed.LastEpoch`` if there are signed features (residuals)


@cache
def feature_kinds() -> dict[str, Json]:
    """Read the fields of every kind of feature from data/features.json."""
    # Means and deviations were measured 2026-11-23 (commit 476d657): 24 episodes with random
    # actions for each combination of scene, radio, kind of beliefs and set of modes (two modes,
    # without and with odometry; eight modes; the radio's bank). The file has medians over the
    # combinations. No value was clipped.
    return shipped_json("features")["kinds"]  # type: ignore[no-any-return]


class Feature(NamedTuple):
    """One component of the observation: (clip(value, low, high) - mean) / deviation.

    Make features with :func:`feature`. :mod:`mmwave_env.interface.observation` also limits a
    feature to ten standard deviations from the mean.
    """

    name: str  # unique in the table
    value: Callable[..., Number]  # formula, a function of a View
    kind: str  # name without its anchor or mode
    meaning: str  # meaning, with the formula if the name does not imply it
    unit: str  # unit of the value
    # low, high: limits of the value
    low: float
    high: float
    # mean, deviation: numbers, in the feature's unit, that standardize the feature
    mean: float
    deviation: float


def feature(kind: str, value: Callable[..., Number], of: str = "", **limits: float) -> Feature:
    """Return the feature of a kind for the anchor or mode ``of``; ``limits`` replace the kind's."""
    return Feature(f"{kind} {of}".rstrip(), value, kind, **feature_kinds()[kind] | limits)


def context(pipeline: Pipeline, per_mode: bool) -> list[Feature]:
    """Return the features that are known before any mode has processed the coming epoch.

    Args:
        pipeline: modes and layout.
        per_mode: whether every mode keeps its own belief. If so, no feature depends on the size
            of the streets, so that a policy trained in one scene works in others.
    """
    layout = pipeline.layout
    table = [*_motion(layout), *last_epoch(layout)]
    if per_mode:
        return [*table, *_links(layout, False), *_track(), *_mixture(pipeline)]
    return [*table, *_links(layout, True), *_previous(pipeline), *_track()]


def _speed(view: View) -> Number:
    return norms(view.x[3:6])[1]


def _motion(layout: Layout) -> list[Feature]:
    table = [
        feature("predicted speed", _speed),
        feature("Doppler spread", lambda v: v.epoch.doppler_spread_hz / v.site.hz_per_mps),
        feature("Doppler spread average", lambda v: v.memory.spread_average_hz / v.site.hz_per_mps),
        feature(
            "odometry speed",
            lambda v: where(v.epoch.visible[-1] > 0.5, v.epoch.z[-2], _speed(v)),
        ),
    ]
    return table if layout.odometry else table[:-1]


def _of_groups(
    name: str, layout: Layout, value: Callable[..., Number], of: str = ""
) -> list[Feature]:
    """Return a feature of each group (link, Doppler, odometry), whose index ``value`` gets, too."""
    table = []
    for g, group in enumerate(layout.group_names):
        kind = f"{name} {'link' if g < layout.anchors else group}"
        named = f"{name} {group} {of}".rstrip()
        table.append(feature(kind, lambda v, g=g: value(v, g))._replace(name=named))
    return table


def _log_trace(view: View, first: int) -> Number:
    return log(view.P[first][first] + view.P[first + 1][first + 1] + 1e-12)


def last_epoch(layout: Layout) -> list[Feature]:
    """Return the features of the last epoch's gates, and of the belief after that epoch."""
    return [
        *_of_groups("NIS", layout, lambda v, g: log(1.0 + v.memory.nis[g])),
        *_of_groups("verdict", layout, lambda v, g: v.memory.accepted[g] - v.memory.rejected[g]),
        feature("position variance", lambda v: _log_trace(v, 0)),
        feature("velocity variance", lambda v: _log_trace(v, 3)),
    ]


def _distance(view: View, anchor: int) -> Number:
    return norms(minus(move(view.x[:7], view.epoch.dt), view.site.anchors[anchor]))[1]


def _snr_drop(view: View, anchor: int) -> Number:
    visible = view.epoch.visible[anchor] > 0.5
    return where(visible, view.memory.snr_mean_db[anchor] - view.epoch.snr_db[anchor], 0.0)


def _snr(view: View, anchor: int) -> Number:
    return where(view.epoch.visible[anchor] > 0.5, view.epoch.snr_db[anchor], MISSING_SNR_DB)


def _links(layout: Layout, distances: bool) -> list[Feature]:
    """Return features of links: SNRs, then either distances or the number of visible links."""
    L = layout.anchors
    formulas = {"SNR": _snr, "SNR drop": _snr_drop}
    if distances:
        formulas["distance"] = _distance
    table = [
        feature(kind, partial(formula, anchor=a), f"anchor {a + 1}")
        for a in range(L)
        for kind, formula in formulas.items()
    ]
    if not distances:
        table.append(feature("visible links", lambda v: sum(v.epoch.visible[:L], 0.0), high=L))
    return table


def _previous(pipeline: Pipeline) -> list[Feature]:
    def ran(view: View, m: int) -> Number:
        return where(abs(view.memory.mode - float(m)) < 0.5, 1.0, 0.0)

    modes = enumerate(pipeline.modes)
    return [feature("previous mode", partial(ran, m=m), mode.name) for m, mode in modes]


def _track() -> list[Feature]:
    """Return the features of the track's memory."""
    return [
        feature("NIS fast average", lambda v: v.memory.nis_average[0]),
        feature("NIS slow average", lambda v: v.memory.nis_average[1]),
        feature("correction along", lambda v: v.memory.correction[0]),
        feature("correction across", lambda v: v.memory.correction[1]),
        feature("gamma", lambda v: v.memory.gamma),
        feature("lock-out", lambda v: v.memory.lockout),
        feature("time since fix", lambda v: v.memory.unfixed_s),
    ]


def _log_odds(p: Number) -> Number:
    """Compute the log-odds ln(p / (1 - p)) of a probability, which may be 0 or 1."""
    return log(maximum(p, _LEAST) / maximum(1.0 - p, _LEAST))


def _mixture(pipeline: Pipeline) -> list[Feature]:
    return [
        *(
            feature(
                f"Doppler spread {pace} average",
                lambda v, i=i: v.spread_averages_hz[i] / v.site.hz_per_mps,
            )
            for i, pace in enumerate(("fast", "slow", "slowest"))
        ),
        *(
            feature("predicted log-odds", lambda v, m=m: _log_odds(v.predicted[m]), mode.name)
            for m, mode in enumerate(pipeline.modes)
        ),
    ]


def coming(pipeline: Pipeline, per_mode: bool) -> list[Feature]:
    """Return features of each mode's result for the coming epoch, such as its likelihood.

    The list begins with the Doppler innovation and the NIS of the pipeline's last mode. Features of
    each mode follow, in the pipeline's order; all modes but the last are compared with the last. If
    ``per_mode``, the list ends with probabilities and velocities of modes. An observation of the
    kind "prior" has none of these features. The arguments are the same as for :func:`context`.
    """
    layout = pipeline.layout
    names = [mode.name for mode in pipeline.modes]
    table = [
        feature("coming Doppler innovation", _doppler_innovation),
        *_of_groups(
            "coming NIS", layout, lambda v, g: log(1.0 + v.candidates[-1].nis[g]), names[-1]
        ),
    ]
    for m, name in enumerate(names):
        table += _candidate(m, name, layout.anchors)
        if name != names[-1]:
            table += _against(m, name)
    if per_mode:
        for m, name in enumerate(names):
            table += _posterior(m, name)
    return table


def _doppler_innovation(view: View) -> Number:
    """Compute the measured minus the predicted radial velocity, m/s; 0 without a measurement."""
    layout = view.layout
    x = move(view.x[:7], view.epoch.dt)
    step = minus(x, doppler_anchor(view.site.anchors, view.epoch.doppler_of))
    measured = (view.epoch.z[layout.doppler] - x[6]) / view.site.hz_per_mps
    innovation = measured - range_rate(step, x[3:6])
    return where(view.epoch.visible[layout.anchors] > 0.5, innovation, 0.0)


def _mean_nis(view: View, m: int) -> Number:
    epoch = view.epoch
    rows = dot(epoch.visible, view.layout.degrees(epoch.measured))
    return dot(epoch.visible, view.candidates[m].nis) / where(rows > 0.5, rows, 1.0)


def _log_variance(view: View, m: int, i: int, j: int) -> Number:
    """Compute ln of the sum of two variances, by their indices in a mode's packed covariance."""
    P = view.candidates[m].P
    return log(P[i] + P[j] + 1e-12)


def _candidate(m: int, name: str, anchors: int) -> list[Feature]:
    def rejected(view: View) -> Number:
        visible = sum(view.epoch.visible[:anchors], 0.0)
        return visible - sum(view.candidates[m].accepted[:anchors], 0.0)

    def correction(view: View, first: int, i: int) -> Number:
        return correction_of(view.x, view.candidates[m], view.epoch.dt, first)[i]

    return [
        feature("coming NIS", lambda v: log(1.0 + _mean_nis(v, m)), name),
        feature("coming rejected", rejected, name, high=anchors),
        feature("coming variance", partial(_log_variance, m=m, i=0, j=2), name),
        *(
            feature(
                f"coming {quantity} correction {way}", partial(correction, first=first, i=i), name
            )
            for quantity, first in (("position", 0), ("velocity", 3))
            for i, way in enumerate(WAYS)
        ),
    ]


def _against(m: int, name: str) -> list[Feature]:
    def likelihood(view: View, mode: int) -> Number:
        degrees = view.layout.degrees(view.epoch.measured)
        return capped_log_likelihood(view.candidates[mode], degrees)

    return [
        feature("coming log-likelihood", lambda v: likelihood(v, m) - likelihood(v, -1), name),
        feature("preference fast", lambda v: v.memory.preference[0][m], name),
        feature("preference slow", lambda v: v.memory.preference[1][m], name),
    ]


def _posterior(m: int, name: str) -> list[Feature]:
    """Return features of a mode after the coming measurement: its probability and its velocity."""

    def speed(view: View) -> Number:
        v = view.candidates[m].x[3:5]
        return log(0.05 + sqrt(dot(v, v) + 1e-9))

    return [
        feature("coming log-odds", lambda v: _log_odds(v.posterior[m]), name),
        feature("coming speed", speed, name),
        feature("coming velocity variance", partial(_log_variance, m=m, i=9, j=14), name),
    ]
