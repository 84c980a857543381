"""Features of an observation, each with its formula.

An estimator can compute each feature at run time; none uses the truth. The formulas are functions
of plain numbers, so that they can be compiled into the SIMD kernel.
"""

import json
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from mmwave_env.filters.memory import Memory, correction_of
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.update import ModeResult, capped_log_likelihood
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site, doppler_anchor, norms, range_rate
from mmwave_env.models.motion import move
from mmwave_env.numerics.linalg import dot, minus
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Vector, log, maximum, sqrt, where

MISSING_SNR_DB = -20.0
# kind of an anchor's feature -> the feature's value if the anchor is never visible
UNSEEN = {"NIS": 0.0, "verdict": 0.0, "SNR": MISSING_SNR_DB, "SNR drop": 0.0, "coming NIS": 0.0}
UNSEEN |= dict.fromkeys(
    (
        *(f"{row} {of}" for row in ("range", "azimuth", "departure")
          for of in ("residual along", "residual across", "deviation")),
        "elevation residual", "elevation deviation", "measured", "last SNR",
    ), 0.0)  # fmt: skip
_LEAST = 1e-9  # lower limit of a probability in a logarithm
_WAYS = {  # components of a horizontal vector -> their meaning
    "along": "component along the predicted velocity",
    "across": "component to the left of the predicted velocity",
}


class MixtureView(NamedTuple):
    """The inputs of features that exist only if each mode has its own belief."""

    # predicted, posterior: (modes,) probabilities of modes before and after the coming measurement
    predicted: Numbers
    posterior: Numbers
    spread_averages_hz: Numbers  # moving averages of the Doppler spread, fast to slow


class View(NamedTuple):
    """The inputs of features."""

    # x, P: mean (7,) and covariance (7, 7) of the belief after the last epoch
    x: Vector
    P: Matrix
    memory: Memory  # memory of the track
    candidates: list[ModeResult]  # each mode's result for the coming epoch
    epoch: Epoch  # the coming epoch
    site: Site  # anchors and carrier
    mixture: Any = None  # a MixtureView if each mode has its own belief, else None
    last: Any = None  # a ``signed.LastEpoch`` if there are signed features (residuals)


class Scale(NamedTuple):
    """The mean and standard deviation, in a feature's unit, that standardize the feature."""

    mean: float
    deviation: float


@cache
def feature_scales() -> dict[str, Scale]:
    """Read mean and standard deviation of every kind of feature from data/feature_scales.json."""
    # Measured 2026-11-23 (commit 476d657): 24 episodes with random actions for each combination of
    # scene, radio, kind of beliefs and set of modes (two modes, without and with odometry; eight
    # modes; the radio's bank). The file has medians over the combinations. No value was clipped.
    text = files("mmwave_env").joinpath("data/feature_scales.json").read_text(encoding="utf-8")
    return {kind: Scale(**scale) for kind, scale in json.loads(text)["kinds"].items()}


class Feature(NamedTuple):
    """One component of the observation: (clip(value, low, high) - mean) / deviation.

    Mean and standard deviation depend on the kind; :mod:`mmwave_env.interface.observation` also
    limits the feature to ten standard deviations from the mean.
    """

    name: str  # unique in the table
    meaning: str  # meaning, with the formula if the name does not imply it
    unit: str  # unit of the value
    # low, high: limits of the value
    low: float
    high: float
    value: Callable[..., Number]  # formula, a function of a View
    kind: str = ""  # name without its anchor or mode; "" if it has none

    @property
    def scale(self) -> Scale:
        """Return the mean and standard deviation of the feature's kind."""
        return feature_scales()[self.kind or self.name]


def context(pipeline: Pipeline, per_mode: bool = False) -> list[Feature]:
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
        Feature("predicted speed", "norm of the predicted velocity", "m/s", 0, 50, _speed),
        Feature("Doppler spread", "Doppler spread of the coming epoch, divided by f_c / c", "m/s",
                0, 50, lambda v: v.epoch.doppler_spread_hz / v.site.hz_per_mps),
        Feature("Doppler spread average",
                "moving average of the Doppler spread, divided by f_c / c", "m/s", 0, 50,
                lambda v: v.memory.spread_average_hz / v.site.hz_per_mps),
        Feature("odometry speed",
                "speed measured by odometry in the coming epoch; predicted speed if missing", "m/s",
                0, 50, lambda v: where(v.epoch.visible[-1] > 0.5, v.epoch.z[-2], _speed(v))),
    ]  # fmt: skip
    return table if layout.odometry else table[:-1]


def _named_groups(layout: Layout) -> list[tuple[int, str, str]]:
    """Return number, name and kind of every group of measurements (links, Doppler, odometry)."""
    return [
        (g, name, "link" if g < layout.anchors else name)
        for g, name in enumerate(layout.group_names)
    ]


def _log_trace(view: View, first: int) -> Number:
    return log(view.P[first][first] + view.P[first + 1][first + 1] + 1e-12)


def last_epoch(layout: Layout) -> list[Feature]:
    """Return the features of the last epoch's gates, and of the belief after that epoch."""
    groups = _named_groups(layout)
    return [
        *(Feature(f"NIS {name}", "ln(1 + NIS) of the last epoch", "", 0, 10,
                  lambda v, g=g: log(1.0 + v.memory.nis[g]), f"NIS {kind}")
          for g, name, kind in groups),
        *(Feature(f"verdict {name}", "in the last epoch: 1 accepted, -1 rejected by the gate, "
                  "0 missing", "", -1, 1,
                  lambda v, g=g: v.memory.accepted[g] - v.memory.rejected[g], f"verdict {kind}")
          for g, name, kind in groups),
        Feature("position variance", "ln of the trace of P for the horizontal position", "ln m^2",
                -20, 20, lambda v: _log_trace(v, 0)),
        Feature("velocity variance", "ln of the trace of P for the horizontal velocity",
                "ln (m/s)^2", -20, 20, lambda v: _log_trace(v, 3)),
    ]  # fmt: skip


def _distance(view: View, anchor: int) -> Number:
    return norms(minus(move(view.x[:7], view.epoch.dt), view.site.anchors[anchor]))[1]


def _links(layout: Layout, distances: bool) -> list[Feature]:
    """Return features of links: SNRs, then either distances or the number of visible links."""
    table = []
    for a in range(layout.anchors):
        table += [
            Feature(f"SNR anchor {a + 1}",
                    f"SNR in the coming epoch; {MISSING_SNR_DB:g} dB if missing", "dB", -20, 80,
                    lambda v, a=a: where(
                        v.epoch.visible[a] > 0.5, v.epoch.snr_db[a], MISSING_SNR_DB), "SNR"),
            Feature(f"SNR drop anchor {a + 1}", "slow average SNR, minus the current SNR; 0 if "
                    "missing", "dB", -20, 40, lambda v, a=a: where(
                        v.epoch.visible[a] > 0.5, v.memory.snr_mean_db[a] - v.epoch.snr_db[a], 0.0),
                    "SNR drop"),
            Feature(f"distance anchor {a + 1}", "distance of the predicted position to the anchor",
                    "m", 0, 1000, lambda v, a=a: _distance(v, a), "distance"),
        ][: 3 if distances else 2]  # fmt: skip
    if not distances:
        table.append(Feature("visible links", "number of visible links in the coming epoch",
                             "links", 0, layout.anchors,
                             lambda v: sum(v.epoch.visible[: layout.anchors], 0.0)))  # fmt: skip
    return table


def _previous(pipeline: Pipeline) -> list[Feature]:
    return [
        Feature(f"previous mode {mode.name}", "1 if this mode ran in the last epoch, else 0", "", 0,
                1, lambda v, m=m: where(abs(v.memory.mode - float(m)) < 0.5, 1.0, 0.0),
                "previous mode")
        for m, mode in enumerate(pipeline.modes)
    ]  # fmt: skip


def _track() -> list[Feature]:
    """Return the features of the track's memory."""
    return [
        *(Feature(f"NIS {pace} average", "average NIS / dof of accepted groups", "", 0, 10,
                  lambda v, i=i: v.memory.nis_average[i])
          for i, pace in enumerate(("fast", "slow"))),
        *(Feature(f"correction {way}", f"average position correction {way} the velocity", "m", -10,
                  10, lambda v, i=i: v.memory.correction[i])
          for i, way in enumerate(("along", "across"))),
        Feature("gamma", "adaptive scale of Q and R", "", 0.5, 2, lambda v: v.memory.gamma),
        Feature("lock-out", "successive epochs in which all visible links failed their gates",
                "epochs", 0, 10, lambda v: v.memory.lockout),
        Feature("time since fix", "time since a link was last accepted", "s", 0, 50,
                lambda v: v.memory.unfixed_s),
    ]  # fmt: skip


def _log_odds(p: Number) -> Number:
    """Compute the log-odds ln(p / (1 - p)) of a probability, which may be 0 or 1."""
    return log(maximum(p, _LEAST) / maximum(1.0 - p, _LEAST))


def _mixture(pipeline: Pipeline) -> list[Feature]:
    return [
        *(Feature(f"Doppler spread {pace} average", "average divided by f_c / c", "m/s", 0, 16,
                  lambda v, i=i: v.mixture.spread_averages_hz[i] / v.site.hz_per_mps)
          for i, pace in enumerate(("fast", "slow", "slowest"))),
        *(Feature(f"predicted log-odds {mode.name}",
                  "log-odds of the mode before the coming measurement",
                  "", -16, 16, lambda v, m=m: _log_odds(v.mixture.predicted[m]),
                  "predicted log-odds") for m, mode in enumerate(pipeline.modes)),
    ]  # fmt: skip


def coming(pipeline: Pipeline, per_mode: bool = False) -> list[Feature]:
    """Return features of each mode's result for the coming epoch, such as its likelihood.

    The list begins with the Doppler innovation and the NIS of the pipeline's last mode. Features of
    each mode follow, in the pipeline's order; all modes but the last are compared with the last. If
    ``per_mode``, the list ends with probabilities and velocities of modes. An observation of the
    kind "prior" has none of these features. The arguments are the same as for :func:`context`.
    """
    layout = pipeline.layout
    modes = pipeline.modes
    table = _innovation(pipeline)
    for m, mode in enumerate(modes):
        table += _candidate(layout, m, mode.name)
        if m < len(modes) - 1:
            table += _against(layout, m, mode.name, modes[-1].name)
    if per_mode:
        for m, mode in enumerate(modes):
            table += _posterior(m, mode.name)
    return table


def _doppler_innovation(view: View, layout: Layout) -> Number:
    """Compute the measured minus the predicted radial velocity, m/s; 0 without a measurement."""
    x = move(view.x[:7], view.epoch.dt)
    step = minus(x, doppler_anchor(view.site.anchors, view.epoch.doppler_of))
    measured = (view.epoch.z[layout.doppler] - x[6]) / view.site.hz_per_mps
    innovation = measured - range_rate(step, x[3:6])
    return where(view.epoch.visible[layout.anchors] > 0.5, innovation, 0.0)


def _innovation(pipeline: Pipeline) -> list[Feature]:
    layout = pipeline.layout
    last = pipeline.modes[-1].name
    return [
        Feature("coming Doppler innovation", "innovation of the radial velocity; 0 if missing",
                "m/s", -10, 10, lambda v: _doppler_innovation(v, layout)),
        *(Feature(f"coming NIS {name} {last}", "ln(1 + NIS) in the coming epoch", "", 0, 10,
                  lambda v, g=g: log(1.0 + v.candidates[-1].nis[g]), f"coming NIS {kind}")
          for g, name, kind in _named_groups(layout)),
    ]  # fmt: skip


def _mean_nis(layout: Layout, candidate: ModeResult, epoch: Epoch) -> Number:
    rows = dot(epoch.visible, layout.degrees(epoch.measured))
    return dot(epoch.visible, candidate.nis) / where(rows > 0.5, rows, 1.0)


def _candidate(layout: Layout, m: int, name: str) -> list[Feature]:
    links = slice(layout.anchors)
    return [
        Feature(f"coming NIS {name}", "ln(1 + NIS / dof) over the visible groups", "", 0, 10,
                lambda v: log(1.0 + _mean_nis(layout, v.candidates[m], v.epoch)), "coming NIS"),
        Feature(f"coming rejected {name}", "number of links that the mode would reject", "links",
                0, layout.anchors,
                lambda v: (sum(v.epoch.visible[links], 0.0)
                           - sum(v.candidates[m].accepted[links], 0.0)),
                "coming rejected"),
        Feature(f"coming variance {name}",
                "ln of the trace of the mode's P for the horizontal position", "ln m^2", -20, 20,
                lambda v: log(v.candidates[m].P[0] + v.candidates[m].P[2] + 1e-12),
                "coming variance"),
        *(Feature(f"coming {of} correction {way} {name}", meaning, unit, -10, 10,
                  lambda v, first=first, i=i: correction_of(
                      v.x, v.candidates[m], v.epoch.dt, first)[i],
                  f"coming {of} correction {way}")
          for of, first, unit in (("position", 0, "m"), ("velocity", 3, "m/s"))
          for i, (way, meaning) in enumerate(_WAYS.items())),
    ]  # fmt: skip


def _against(layout: Layout, m: int, name: str, last: str) -> list[Feature]:
    def likelihood(view: View, mode: int) -> Number:
        return capped_log_likelihood(view.candidates[mode], layout.degrees(view.epoch.measured))

    return [
        Feature(f"coming log-likelihood {name}", "log-likelihood minus the log-likelihood of "
                f"{last}; each NIS is limited to its 99.9 % quantile", "nats", -30, 30,
                lambda v: likelihood(v, m) - likelihood(v, -1), "coming log-likelihood"),
        *(Feature(f"preference {pace} {name}",
                  f"{pace} average of coming log-likelihood {name}", "nats", -30, 30,
                  lambda v, i=i: v.memory.preference[i][m], f"preference {pace}")
          for i, pace in enumerate(("fast", "slow"))),
    ]  # fmt: skip


def _posterior(m: int, name: str) -> list[Feature]:
    """Return features of a mode after the coming measurement: its probability and its velocity."""
    return [
        Feature(f"coming log-odds {name}", "log-odds of the mode after the coming measurement", "",
                -16, 16, lambda v: _log_odds(v.mixture.posterior[m]), "coming log-odds"),
        Feature(f"coming speed {name}", "ln(horizontal speed of the mode + 0.05 m/s)", "ln m/s",
                -4, 4, lambda v: _log_speed(v, m), "coming speed"),
        Feature(f"coming velocity variance {name}",
                "ln of the trace of the mode's P for the horizontal velocity", "ln (m/s)^2",
                -20, 20, lambda v: log(v.candidates[m].P[9] + v.candidates[m].P[14] + 1e-12),
                "coming velocity variance"),
    ]  # fmt: skip


def _log_speed(view: View, mode: int) -> Number:
    v = view.candidates[mode].x[3:5]
    return log(0.05 + sqrt(dot(v, v) + 1e-9))
