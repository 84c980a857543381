"""The features that an observation consists of, each with its formula.

How each mode sees the coming epoch is in ``coming_features.py``, all else is here.

Every feature is something an estimator knows at run time; none sees the truth. The formulas
are functions of numbers, so they are computed inside the SIMD kernel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from mmwave_env.filters.memory import Memory
from mmwave_env.filters.mode_result import ModeResult
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.epoch import Epoch, Site
from mmwave_env.models.measurement import Layout
from mmwave_env.models.motion import move
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Matrix, Number, Vector, log, maximum, sqrt, where

Index = TypeVar("Index")

MISSING_SNR_DB = -20.0
_LEAST = 1e-9  # probability, where its logarithm is taken


class MixtureView(NamedTuple):
    """What a feature may look at where every mode keeps its own belief."""

    # predicted, posterior: (modes,) probabilities before and after the coming epoch's measurement
    predicted: list[Number]
    posterior: list[Number]
    spread_averages_hz: list[Number]  # of the Doppler spread, from fast to slow


class View(NamedTuple):
    """What a feature may look at."""

    # x, P: (7,), (7, 7) belief after the last epoch
    x: Vector
    P: Matrix
    memory: Memory  # of the track
    candidates: list[ModeResult]  # per mode, what it would make of the coming epoch
    epoch: Epoch  # the coming epoch
    site: Site  # anchors and carrier
    mixture: MixtureView | None = None  # where every mode keeps its own belief


@dataclass(frozen=True)
class Feature:
    """One component of the observation: (clip(value, low, high) - mean) / deviation.

    Mean and deviation are those of its kind (:mod:`mmwave_env.observation`), from where it is
    also limited to ten deviations.
    """

    name: str  # unique in the table
    kind: str  # the name without which anchor or mode it is of
    meaning: str  # what it is, with the formula where the name does not say it
    unit: str  # of the value
    # low, high: limits of the value
    low: float
    high: float
    value: Callable[[View], Number]  # the formula


def context(pipeline: Pipeline, per_mode: bool = False) -> list[Feature]:
    """What is known before any mode has looked at the coming epoch.

    Args:
        pipeline: modes and layout.
        per_mode: whether every mode keeps its own belief. Nothing then depends on how large a
            street is, so that what is learned in one holds in others.
    """
    layout = pipeline.layout
    first = [*_speed_and_spread(layout), *_last_epoch(layout), *_belief()]
    last = [*_averages(), *_recovery()]
    if per_mode:
        return [*first, *_signals(layout), *last, *_spread_averages(), *_predicted(pipeline)]
    return [*first, *_links(layout), *_previous(pipeline), *last]


def at(function: Callable[[View, Index], Number], index: Index) -> Callable[[View], Number]:
    """The formula of one anchor, group or mode."""
    return lambda view: function(view, index)


def _speed(view: View) -> Number:
    v = view.x[3:6]
    return sqrt(dot(v, v))


def _speed_and_spread(layout: Layout) -> list[Feature]:
    table = [
        Feature(
            "predicted speed", "predicted speed", "norm of the predicted velocity", "m/s", 0, 50,
            _speed,
        ),
        Feature(
            "Doppler spread", "Doppler spread", "of the coming epoch, over f_c / c", "m/s", 0, 50,
            lambda v: v.epoch.doppler_spread_hz / v.site.hz_per_mps,
        ),
        Feature(
            "Doppler spread average", "Doppler spread average", "the same, averaged", "m/s", 0, 50,
            lambda v: v.memory.spread_average_hz / v.site.hz_per_mps,
        ),
    ]  # fmt: skip
    if layout.odometry:
        table.append(
            Feature(
                "odometry speed", "odometry speed",
                "of the coming epoch; predicted speed where missing", "m/s", 0, 50,
                lambda v: where(
                    v.epoch.visible[-1] > 0.5, v.epoch.z[layout.doppler + 1], _speed(v)
                ),
            )
        )  # fmt: skip
    return table


def named_groups(layout: Layout) -> list[tuple[int, str, str]]:
    """Number, name and kind of every group of measurements."""
    return [
        (g, name, "link" if g < layout.anchors else name)
        for g, name in enumerate(layout.group_names)
    ]


def _last_epoch(layout: Layout) -> list[Feature]:
    nis = [
        Feature(
            f"NIS {name}", f"NIS {kind}", "ln(1 + NIS) of the last epoch", "", 0, 10,
            at(lambda v, g: log(1.0 + v.memory.nis[g]), g),
        )
        for g, name, kind in named_groups(layout)
    ]  # fmt: skip
    verdict = [
        Feature(
            f"verdict {name}", f"verdict {kind}", "last epoch: 1 accepted, -1 gated, 0 missing",
            "", -1, 1, at(lambda v, g: v.memory.accepted[g] - v.memory.rejected[g], g),
        )
        for g, name, kind in named_groups(layout)
    ]  # fmt: skip
    return nis + verdict


def _log_trace(first: int) -> Callable[[View], Number]:
    return lambda view: log(view.P[first][first] + view.P[first + 1][first + 1] + 1e-12)


def _belief() -> list[Feature]:
    return [
        Feature(
            "position variance", "position variance", "ln of the trace of P, horizontal position",
            "ln m^2", -20, 20, _log_trace(0),
        ),
        Feature(
            "velocity variance", "velocity variance", "ln of the trace of P, horizontal velocity",
            "ln (m/s)^2", -20, 20, _log_trace(3),
        ),
    ]  # fmt: skip


def _snr(view: View, anchor: int) -> Number:
    return where(view.epoch.visible[anchor] > 0.5, view.epoch.snr_db[anchor], MISSING_SNR_DB)


def _snr_drop(view: View, anchor: int) -> Number:
    drop = view.memory.snr_mean_db[anchor] - view.epoch.snr_db[anchor]
    return where(view.epoch.visible[anchor] > 0.5, drop, 0.0)


def _distance(view: View, anchor: int) -> Number:
    predicted = move(view.x, view.epoch.dt)
    step = [predicted[i] - view.site.anchors[anchor][i] for i in range(3)]
    return sqrt(dot(step, step))


def _signal(anchor: int) -> list[Feature]:
    return [
        Feature(
            f"SNR anchor {anchor + 1}", "SNR",
            f"of the coming epoch; {MISSING_SNR_DB:g} dB where missing", "dB", -20, 80,
            at(_snr, anchor),
        ),
        Feature(
            f"SNR drop anchor {anchor + 1}", "SNR drop",
            "its slow mean minus SNR; 0 where missing", "dB", -20, 40, at(_snr_drop, anchor),
        ),
    ]  # fmt: skip


def _links(layout: Layout) -> list[Feature]:
    table = []
    for a in range(layout.anchors):
        table += _signal(a)
        table.append(
            Feature(
                f"distance anchor {a + 1}", "distance", "of the predicted position", "m", 0, 1000,
                at(_distance, a),
            )
        )  # fmt: skip
    return table


def _signals(layout: Layout) -> list[Feature]:
    each = [1.0] * layout.anchors
    seen = Feature(
        "visible links", "visible links", "of the coming epoch", "links", 0, layout.anchors,
        lambda v: dot(each, v.epoch.visible[: layout.anchors]),
    )  # fmt: skip
    return [*(feature for a in range(layout.anchors) for feature in _signal(a)), seen]


def _previous(pipeline: Pipeline) -> list[Feature]:
    return [
        Feature(
            f"previous mode {mode.name}", "previous mode", "1 if it ran in the last epoch", "",
            0, 1,
            at(lambda v, m: where(abs(v.memory.mode - float(m)) < 0.5, 1.0, 0.0), m),
        )
        for m, mode in enumerate(pipeline.modes)
    ]  # fmt: skip


def _averages() -> list[Feature]:
    nis = [
        Feature(
            f"NIS {pace} average", f"NIS {pace} average", "of NIS / dof of what was accepted", "",
            0, 10, at(lambda v, i: v.memory.nis_average[i], i),
        )
        for i, pace in enumerate(("fast", "slow"))
    ]  # fmt: skip
    correction = [
        Feature(
            f"correction {way}", f"correction {way}",
            f"average position correction {way} the velocity", "m", -10, 10,
            at(lambda v, i: v.memory.correction[i], i),
        )
        for i, way in enumerate(("along", "across"))
    ]  # fmt: skip
    return nis + correction


def _recovery() -> list[Feature]:
    return [
        Feature(
            "gamma", "gamma", "adaptive scale of Q and R", "", 0.5, 2, lambda v: v.memory.gamma
        ),
        Feature(
            "lock-out", "lock-out", "epochs in a row with no visible link within its gate",
            "epochs", 0, 10, lambda v: v.memory.lockout,
        ),
        Feature(
            "time since fix", "time since fix", "since a link was last accepted", "s", 0, 50,
            lambda v: v.memory.unfixed_s,
        ),
    ]  # fmt: skip


def mixture_of(view: View) -> MixtureView:
    """What only features of beliefs per mode look at."""
    assert view.mixture is not None  # these features are of environments that have one
    return view.mixture


def log_odds(p: Number) -> Number:
    """ln(p / (1 - p)) of a probability, which may be 0 or 1."""
    return log(maximum(p, _LEAST) / maximum(1.0 - p, _LEAST))


def _spread_averages() -> list[Feature]:
    return [
        Feature(
            f"Doppler spread {pace} average", f"Doppler spread {pace} average", "over f_c / c",
            "m/s", 0, 16,
            at(lambda v, i: mixture_of(v).spread_averages_hz[i] / v.site.hz_per_mps, i),
        )
        for i, pace in enumerate(("fast", "slow", "slowest"))
    ]  # fmt: skip


def _predicted(pipeline: Pipeline) -> list[Feature]:
    return [
        Feature(
            f"predicted log-odds {mode.name}", "predicted log-odds",
            "of the mode, before the coming measurement", "", -16, 16,
            at(lambda v, m: log_odds(mixture_of(v).predicted[m]), m),
        )
        for m, mode in enumerate(pipeline.modes)
    ]  # fmt: skip
