"""What the page's script draws: pictures as data, each with the words that stand for it."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import chdtri

from experiments.webpage.episodes import numbers
from experiments.webpage.kinds import events
from experiments.webpage.played import Played
from experiments.webpage.source import Source
from mmwave_env.localization.position_errors import SHARES, horizontal, vertical
from mmwave_env.lookup import printable
from mmwave_env.metrics import METRICS, nees_interval
from mmwave_env.numerics.arrays import Array

_SHARES = sorted({*np.linspace(0.0, 0.99, 100).round(4).tolist(), 0.995, 0.999, *SHARES})
_LOWEST_SHARE = 0.03  # where a logarithmic axis of errors begins
_WORST_NEES, _LEAST_NEES = 1e3, 1e-2  # that its axis shows

Chart = dict[str, Any]


def _line(name: str, x: Any, y: Any, **more: Any) -> dict[str, Any]:
    return {"name": printable(name), "x": x, "y": y, **more}


def whiskers(source: Source) -> Chart:
    """Means with intervals of every metric, and their paired differences."""
    content = source.content
    views: list[dict[str, Any]] = [
        {"name": what, "rows": _rows(content["policies"], metric)}
        for metric, what in METRICS.items()
    ]
    for reference, pairs in paired(content).items():
        rows = _rows(pairs, "reward")
        what = f"reward minus that of {printable(reference)}"
        views.append({"name": what, "rows": rows, "zero": True})
    return {"kind": "whiskers", "title": "Means with 95 % intervals", "views": views}


def _rows(table: Mapping[str, Any], metric: str) -> list[list[Any]]:
    """Name, mean and ends of the interval."""
    return [
        [printable(name), row[metric]["mean"], *(row[metric]["ci95"] or (None, None))]
        for name, row in table.items()
        if metric in row
    ]


def paired(content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Differences by reference and name; names may hold " - " themselves."""
    found: dict[str, dict[str, Any]] = {}
    everybody = list(content["policies"])
    splits = {f"{one} - {other}": (one, other) for one in everybody for other in everybody}
    for pair, row in content["paired"].items():
        one, other = splits.get(pair) or tuple(pair.split(" - ", 1))
        found.setdefault(other, {})[one] = row
    return found


def error_curves(played: Played) -> Chart:
    """How often horizontal and vertical errors stay below so much."""
    views = []
    for kind, sizes in (("horizontal", horizontal), ("vertical", vertical)):
        lines = [
            _line(name, _quantiles(sizes(errors), _SHARES), _SHARES)
            for name, errors in played.errors_m.items()
        ]
        low = [line["x"][int(_LOWEST_SHARE * 100)] or 0.01 for line in lines]
        views.append({
            "name": f"{kind} error",
            "x": {"label": f"{kind} position error (m)", "log": True, "from": max(1e-3, min(low))},
            "y": {"label": "share of epochs below", "from": 0.0, "to": 1.0,
                  "ticks": [0.0, *SHARES]},
            "lines": lines,
        })  # fmt: skip
    return {"kind": "lines", "title": "Distribution of errors", "views": views}


def _quantiles(values: Array, shares: Sequence[float]) -> list[float | None]:
    """Of all that are finite."""
    finite = values[np.isfinite(values)]
    return numbers(np.quantile(finite, shares)) if finite.size else [None] * len(shares)


def nees_curves(played: Played) -> Chart:
    """NEES against chi-square."""
    shares = np.array(_SHARES[1:])
    x = {"label": f"NEES ({played.axes} axes, no unit)", "log": True, "from": _LEAST_NEES,
         "to": _WORST_NEES, "band": [*nees_interval(played.axes)]}  # fmt: skip
    consistent = _line(
        f"chi-square, {played.axes} degrees of freedom",
        numbers(chdtri(played.axes, 1.0 - shares)), shares.tolist(), reference=True,
    )  # fmt: skip
    lines = [
        _line(name, _quantiles(values, _SHARES[1:]), shares.tolist())
        for name, values in played.nees.items()
    ]
    y = {"label": "share of epochs below", "from": 0.0, "to": 1.0}
    view = {"name": "NEES", "x": x, "y": y, "lines": [*lines, consistent]}
    return {"kind": "lines", "title": "NEES against chi-square", "views": [view]}


def around_events(decisions: Mapping[str, Any]) -> Chart:
    """Errors around stops and pull-aways minus those of the reference, with intervals."""
    views = []
    for kind in events(decisions):
        around = decisions[kind]
        lines = [
            _line(name, decisions["time_s"], band["mean"], low=band["low"], high=band["high"])
            for name, band in around["error_minus_m"].items()
        ]
        views.append({
            "name": f"{kind}: error minus that of {printable(around['minus'])}",
            "x": {"label": f"time since the {kind} (s), of {around['events']:,} events"},
            "y": {"label": "position error minus reference (m)", "zero": True},
            "lines": lines,
        })  # fmt: skip
    return {"kind": "lines", "title": "Around stops and pull-aways", "views": views}


def trust(title: str, around: Mapping[str, Any]) -> Chart:
    """Errors around events, and whom a policy trusts there."""
    views = []
    for kind in events(around):
        one = around[kind]
        x = {"label": f"time since the {kind} (s), of {one['events']:,} events"}
        errors = [_band(name, around["time_s"], row) for name, row in one["error_m"].items()]
        first, *others = map(printable, one["error_m"])
        gain = f"error of {first} minus that of {', '.join(others)}"
        shares = [_line(name, around["time_s"], row) for name, row in one["trusted"].items()]
        views += [
            {"name": f"{kind}: position error", "x": x, "y": {"label": "position error (m)"},
             "lines": errors},
            {"name": f"{kind}: {gain}", "x": x, "y": {"label": "difference (m)", "zero": True},
             "lines": [_band(gain, around["time_s"], one["gain_m"])]},
            {"name": f"{kind}: share of decisions that trust a mode", "x": x,
             "y": {"label": "share of decisions", "from": 0.0, "to": 1.0}, "lines": shares},
        ]  # fmt: skip
    return {"kind": "lines", "title": printable(title), "views": views}


def _band(name: str, x: Any, intervals: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means with their intervals."""
    low, high = zip(*((one["ci95"] or (None, None)) for one in intervals), strict=True)
    return _line(name, x, [one["mean"] for one in intervals], low=[*low], high=[*high])


def profiles(trained: Mapping[str, Any]) -> Chart:
    """How often runs gain more than so much, over seeds and episodes."""
    rivals = dict.fromkeys(rival for run in trained.values() for rival in run["minus"])
    views = []
    for rival in rivals:
        lines = []
        for name, run in trained.items():
            if rival in run["minus"]:
                one = run["minus"][rival]["profile"]
                lines.append(
                    _line(name, one["above"], one["share"], low=one["low"], high=one["high"])
                )
        views.append({
            "name": f"against {printable(rival)}", "lines": lines,
            "x": {"label": "reward more than the rival's by", "zero": True},
            "y": {"label": "share of seeds and episodes", "from": 0.0, "to": 1.0},
        })  # fmt: skip
    return {"kind": "lines", "title": "Performance profiles", "views": views}


def learning_curves(runs: Sequence[Source]) -> Chart | None:
    """Figures on tuning seeds over steps, a line a training; None where there are none."""
    figures: dict[str, None] = {}
    for run in runs:
        for curve in run.content["curves"].values():
            figures |= dict.fromkeys(name for name in curve if name not in ("seed", "episodes"))
    ranked = sorted(figures, key=_by_use)
    views = [
        {
            "name": f"{_named(figure)}, tuning seeds",
            "x": {"label": "steps", "log": True},
            "y": {"label": _named(figure), "zero": "minus" in figure},
            "lines": list(_trainings(runs, figure)),
        }
        for figure in ranked
    ]
    return {"kind": "lines", "title": "Learning curves", "views": views} if views else None


def _named(figure: str) -> str:
    return printable(f"reward {figure}" if figure.startswith("minus") else figure)


def _by_use(figure: str) -> tuple[bool, bool]:
    """Gains first, those of single places last."""
    return ":" in figure, not figure.startswith("minus")


def _trainings(runs: Sequence[Source], figure: str) -> Iterable[dict[str, Any]]:
    for number, run in enumerate(runs):
        for seed, curve in run.content["curves"].items():
            if figure in curve:
                steps, values = curve[figure]
                name = f"{run.content['name']}, {seed}"
                yield _line(name, steps, values, color=number if len(runs) > 1 else None)
