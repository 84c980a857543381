"""Features of how each mode sees the coming epoch: innovations, corrections, likelihoods.

An observation of the kind "prior" goes without them.
"""

from mmwave_env.features import Feature, View, at, log_odds, mixture_of, named_groups
from mmwave_env.filters.mode_result import ModeResult, capped_log_likelihood
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.epoch import Epoch
from mmwave_env.models.measurement import Layout, range_rate
from mmwave_env.models.motion import move
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Number, log, sqrt, where

_WAYS = {"along": "along the predicted velocity", "across": "to the left of it"}


def coming(pipeline: Pipeline, per_mode: bool = False) -> list[Feature]:
    """The features of the modes, in order; of all but the last also how they compare with it.

    Args:
        pipeline, per_mode: as of :func:`~mmwave_env.features.context`.
    """
    layout, modes = pipeline.layout, pipeline.modes
    table = _innovation(pipeline)
    for m, mode in enumerate(modes):
        table += _candidate(layout, m, mode.name)
        if m < len(modes) - 1:
            table += _against(layout, m, mode.name, modes[-1].name)
    return table + _posterior(pipeline) if per_mode else table


def _doppler_innovation(view: View, layout: Layout) -> Number:
    """Radial velocity measured minus predicted, m/s; 0 where missing."""
    x, base = move(view.x, view.epoch.dt), view.site.anchors[0]
    step = [x[i] - base[i] for i in range(3)]
    measured = (view.epoch.z[layout.doppler] - x[6]) / view.site.hz_per_mps
    innovation = measured - range_rate(step, x[3:6])
    return where(view.epoch.visible[layout.anchors] > 0.5, innovation, 0.0)


def _innovation(pipeline: Pipeline) -> list[Feature]:
    layout, last = pipeline.layout, pipeline.modes[-1].name
    doppler = Feature(
        "coming Doppler innovation", "coming Doppler innovation",
        "of the radial velocity; 0 where missing", "m/s", -10, 10,
        lambda v: _doppler_innovation(v, layout),
    )  # fmt: skip
    nis = [
        Feature(
            f"coming NIS {name} {last}", f"coming NIS {kind}", "ln(1 + NIS) of the group", "", 0,
            10, at(lambda v, g: log(1.0 + v.candidates[-1].nis[g]), g),
        )
        for g, name, kind in named_groups(layout)
    ]  # fmt: skip
    return [doppler, *nis]


def _mean_nis(layout: Layout, candidate: ModeResult, epoch: Epoch) -> Number:
    rows = dot(epoch.visible, [float(r.stop - r.start) for r in layout.groups])
    total = dot(epoch.visible, candidate.nis)
    return total / where(rows > 0.5, rows, 1.0)


def _correction(view: View, mode: int, first: int, across: bool) -> Number:
    """Candidate minus prediction, of two state components, along the velocity or to its left."""
    predicted, candidate = move(view.x, view.epoch.dt), view.candidates[mode]
    step = [candidate.x[i] - predicted[i] for i in (first, first + 1)]
    v = predicted[3:5]
    speed = sqrt(v[0] * v[0] + v[1] * v[1] + 1e-6)
    product = step[1] * v[0] - step[0] * v[1] if across else dot(step, v)
    return product / speed


def _candidate(layout: Layout, m: int, name: str) -> list[Feature]:
    links = [1.0] * layout.anchors
    table = [
        Feature(
            f"coming NIS {name}", "coming NIS", "ln(1 + NIS / dof) over the visible groups", "", 0,
            10, lambda v: log(1.0 + _mean_nis(layout, v.candidates[m], v.epoch)),
        ),
        Feature(
            f"coming rejected {name}", "coming rejected", "links it would reject", "links", 0,
            layout.anchors,
            lambda v: dot(links, v.epoch.visible) - dot(links, v.candidates[m].accepted),
        ),
        Feature(
            f"coming variance {name}", "coming variance",
            "ln of the trace of its P, horizontal position", "ln m^2", -20, 20,
            lambda v: log(v.candidates[m].P[0] + v.candidates[m].P[2] + 1e-12),
        ),
    ]  # fmt: skip
    for of, first, unit in (("position", 0, "m"), ("velocity", 3, "m/s")):
        for way, across in (("along", False), ("across", True)):
            table.append(
                Feature(
                    f"coming {of} correction {way} {name}", f"coming {of} correction {way}",
                    _WAYS[way], unit, -10, 10,
                    at(lambda v, at: _correction(v, m, *at), (first, across)),
                )
            )  # fmt: skip
    return table


def _against(layout: Layout, m: int, name: str, last: str) -> list[Feature]:
    now = Feature(
        f"coming log-likelihood {name}", "coming log-likelihood",
        f"minus that of {last}; NIS counts up to 99.9 %", "nats", -30, 30,
        lambda v: (
            capped_log_likelihood(v.candidates[m], layout)
            - capped_log_likelihood(v.candidates[-1], layout)
        ),
    )  # fmt: skip
    past = [
        Feature(
            f"preference {pace} {name}", f"preference {pace}",
            f"{pace} average of its log-likelihood minus that of {last}", "nats", -30, 30,
            at(lambda v, i: v.memory.preference[i][m], i),
        )
        for i, pace in enumerate(("fast", "slow"))
    ]  # fmt: skip
    return [now, *past]


def _posterior(pipeline: Pipeline) -> list[Feature]:
    """The modes after the coming measurement: how probable each is, and how it says one moves."""
    table = []
    for m, mode in enumerate(pipeline.modes):
        table += [
            Feature(
                f"coming log-odds {mode.name}", "coming log-odds",
                "of the mode, after the coming measurement", "", -16, 16,
                at(lambda v, m: log_odds(mixture_of(v).posterior[m]), m),
            ),
            Feature(
                f"coming speed {mode.name}", "coming speed",
                "ln of the horizontal speed + 0.05 m/s", "ln m/s", -4, 4, at(_log_speed, m),
            ),
            Feature(
                f"coming velocity variance {mode.name}", "coming velocity variance",
                "ln of the trace of its P, horizontal velocity", "ln (m/s)^2", -20, 20,
                at(lambda v, m: log(v.candidates[m].P[9] + v.candidates[m].P[14] + 1e-12), m),
            ),
        ]  # fmt: skip
    return table


def _log_speed(view: View, mode: int) -> Number:
    v = view.candidates[mode].x[3:5]
    return log(0.05 + sqrt(dot(v, v) + 1e-9))
