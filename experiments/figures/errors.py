"""How large errors are, and whether filters know it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from experiments.figures.canvas import contenders, legend_beside, picture, plain_numbers
from mmwave_env.localization.position_errors import SHARES, horizontal, vertical
from mmwave_env.numerics.arrays import Array

SMALLEST_M = 1e-3  # that a logarithmic axis shows
BOUNDS = "95 % bounds if consistent"
_SHARES = np.linspace(0.0, 0.999, 400)
_STYLES = ("-", "--", ":")  # where there are more lines than colors


def _style(number: int) -> dict[str, Any]:
    return {"color": f"C{number % 8}", "ls": _STYLES[number // 8 % len(_STYLES)]}


def draw_error_cdf(errors_m: Mapping[str, Array], path: Path) -> None:
    """How often horizontal and vertical errors stay below so much, as a picture.

    Args:
        errors_m: by contender, position errors (..., 3), m.
        path: .png, .svg or .pdf.
    """
    with picture(path, 11.0, max(4.2, 1.0 + 0.19 * len(errors_m))) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        labels = contenders(errors_m)
        for number, (name, errors) in enumerate(errors_m.items()):
            look = _style(number) | {"label": labels[name]}
            for axes, sizes in ((left, horizontal(errors)), (right, vertical(errors))):
                values = np.maximum(sizes, SMALLEST_M)  # a known height has none
                axes.plot(np.quantile(values, _SHARES), _SHARES, **look)
                axes.plot(np.quantile(values, SHARES), SHARES, "o", ms=3.5, color=look["color"])
        for axes, kind in ((left, "horizontal"), (right, "vertical")):
            low = min(np.interp(0.03, line.get_ydata(), line.get_xdata()) for line in axes.lines)
            axes.set(xscale="log", ylim=(0.0, 1.0), xlabel=f"{kind} position error (m)")
            axes.set_xlim(left=low)
            plain_numbers(axes.xaxis)
        left.set_yticks(SHARES, [f"{100.0 * share:.0f} %" for share in SHARES])
        left.set_ylabel("share of epochs below")
        legend_beside(right)


def draw_consistency(time_s: Array, nees: Mapping[str, Array], dof: int, path: Path) -> None:
    """NEES against its chi-square bounds, as a picture: over time, and all of it.

    Args:
        time_s: (T,) since the begin of an episode.
        nees: (n, T) by contender, of n episodes.
        dof: degrees of freedom: how many coordinates it is of.
        path: .png, .svg or .pdf.
    """
    episodes = len(next(iter(nees.values())))
    low, high = chi2.ppf([0.025, 0.975], episodes * dof) / (episodes * dof)
    with picture(path, 11.0, max(4.2, 1.0 + 0.19 * len(nees))) as figure:
        over_time, whole = figure.subplots(1, 2)
        over_time.axhspan(low, high, color="0.7", lw=0.0, label=BOUNDS)
        whole.plot([0.0, 1.0], [0.0, 1.0], color="0.5", lw=4.0, alpha=0.6, label="consistent")
        names = contenders(nees)
        for number, (name, values) in enumerate(nees.items()):
            look = _style(number) | {"label": names[name]}
            over_time.plot(time_s, values.mean(axis=0) / dof, **look)
            inside = np.sort(chi2.cdf(values, dof), axis=None)
            whole.plot(_SHARES, np.searchsorted(inside, _SHARES, "right") / inside.size, **look)
        over_time.set(xlabel="time since the begin (s)", yscale="log",
                      ylabel=f"mean NEES / {dof}, of {episodes:,} episodes")  # fmt: skip
        plain_numbers(over_time.yaxis)
        whole.set(xlabel="chi-square probability p", xlim=(0.0, 1.0), ylim=(0.0, 1.0),
                  ylabel="share of epochs with NEES below its p-quantile")  # fmt: skip
        bounds, *_ = over_time.get_legend_handles_labels()[0]
        lines, labels = whole.get_legend_handles_labels()
        legend_beside(whole, handles=[bounds, *lines], labels=[BOUNDS, *labels])
