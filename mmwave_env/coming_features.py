"""Features of how each mode sees the coming epoch: innovations, corrections, likelihoods.

An observation of the kind "prior" goes without them.
"""

from mmwave_env.features import Feature, View, log_odds, mixture_of, named_groups
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.update import ModeResult, capped_log_likelihood
from mmwave_env.models.measurement import Epoch, Layout, range_rate
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
    names = [mode.name for mode in modes] if per_mode else []
    return table + [one for m, name in enumerate(names) for one in _posterior(m, name)]


def _doppler_innovation(view: View, layout: Layout) -> Number:
    """Radial velocity measured minus predicted, m/s; 0 where missing."""
    x, base = move(view.x, view.epoch.dt), view.site.anchors[0]
    step = [x[i] - base[i] for i in range(3)]
    measured = (view.epoch.z[layout.doppler] - x[6]) / view.site.hz_per_mps
    innovation = measured - range_rate(step, x[3:6])
    return where(view.epoch.visible[layout.anchors] > 0.5, innovation, 0.0)


def _innovation(pipeline: Pipeline) -> list[Feature]:
    layout, last = pipeline.layout, pipeline.modes[-1].name
    return [
        Feature("coming Doppler innovation", "of the radial velocity; 0 where missing", "m/s", -10,
                10, lambda v: _doppler_innovation(v, layout)),
        *(Feature(f"coming NIS {name} {last}", "ln(1 + NIS) of the group", "", 0, 10,
                  lambda v, g=g: log(1.0 + v.candidates[-1].nis[g]), f"coming NIS {kind}")
          for g, name, kind in named_groups(layout)),
    ]  # fmt: skip


def _mean_nis(layout: Layout, candidate: ModeResult, epoch: Epoch) -> Number:
    rows = dot(epoch.visible, list(map(float, layout.widths)))
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
    return [
        Feature(f"coming NIS {name}", "ln(1 + NIS / dof) over the visible groups", "", 0, 10,
                lambda v: log(1.0 + _mean_nis(layout, v.candidates[m], v.epoch)), "coming NIS"),
        Feature(f"coming rejected {name}", "links it would reject", "links", 0, layout.anchors,
                lambda v: dot(links, v.epoch.visible) - dot(links, v.candidates[m].accepted),
                "coming rejected"),
        Feature(f"coming variance {name}", "ln of the trace of its P, horizontal position",
                "ln m^2", -20, 20,
                lambda v: log(v.candidates[m].P[0] + v.candidates[m].P[2] + 1e-12),
                "coming variance"),
        *(Feature(f"coming {of} correction {way} {name}", meaning, unit, -10, 10,
                  lambda v, first=first, way=way: _correction(v, m, first, way == "across"),
                  f"coming {of} correction {way}")
          for of, first, unit in (("position", 0, "m"), ("velocity", 3, "m/s"))
          for way, meaning in _WAYS.items()),
    ]  # fmt: skip


def _against(layout: Layout, m: int, name: str, last: str) -> list[Feature]:
    def likelihood(view: View, mode: int) -> Number:
        return capped_log_likelihood(view.candidates[mode], layout)

    return [
        Feature(f"coming log-likelihood {name}", f"minus that of {last}; NIS counts up to 99.9 %",
                "nats", -30, 30, lambda v: likelihood(v, m) - likelihood(v, -1),
                "coming log-likelihood"),
        *(Feature(f"preference {pace} {name}",
                  f"{pace} average of its log-likelihood minus that of {last}", "nats", -30, 30,
                  lambda v, i=i: v.memory.preference[i][m], f"preference {pace}")
          for i, pace in enumerate(("fast", "slow"))),
    ]  # fmt: skip


def _posterior(m: int, name: str) -> list[Feature]:
    """A mode after the coming measurement: how probable it is, and how it says one moves."""
    return [
        Feature(f"coming log-odds {name}", "of the mode, after the coming measurement", "", -16, 16,
                lambda v: log_odds(mixture_of(v).posterior[m]), "coming log-odds"),
        Feature(f"coming speed {name}", "ln of the horizontal speed + 0.05 m/s", "ln m/s", -4, 4,
                lambda v: _log_speed(v, m), "coming speed"),
        Feature(f"coming velocity variance {name}", "ln of the trace of its P, horizontal velocity",
                "ln (m/s)^2", -20, 20,
                lambda v: log(v.candidates[m].P[9] + v.candidates[m].P[14] + 1e-12),
                "coming velocity variance"),
    ]  # fmt: skip


def _log_speed(view: View, mode: int) -> Number:
    v = view.candidates[mode].x[3:5]
    return log(0.05 + sqrt(dot(v, v) + 1e-9))
