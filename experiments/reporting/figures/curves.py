"""Pictures of learning curves, of position errors (CDF), and of the consistency of filters."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtr, chdtri

from experiments.reporting.figures.canvas import (
    COLORS,
    PHONE_MM,
    caption,
    contenders,
    legend_of,
    panels,
    plain_numbers,
)
from mmwave_env.localization.position_errors import SHARES, horizontal, vertical
from mmwave_env.numerics.numbers import Array

SMALLEST_M = 1e-3  # smaller errors are drawn at this value, since the axis is logarithmic
BOUNDS = "95 % bounds if consistent"
_SHARES = np.linspace(0.0, 0.999, 400)
Line = tuple[Sequence[float], Sequence[float]]  # steps, values
_STYLES = ("-", "--", ":")  # line styles, to distinguish more lines than there are colors


def _style(number: int) -> dict[str, Any]:
    return {"color": f"C{number}", "ls": _STYLES[number // len(COLORS) % len(_STYLES)]}


def draw_error_cdf(
    errors_m: Mapping[str, Array], path: Path, width_mm: float | None = None
) -> None:
    """Draw the distributions (CDF) of contenders' horizontal and vertical errors (..., 3), m."""
    with panels(path, 2, len(errors_m), width_mm) as (figure, (left, right)):
        labels = contenders(errors_m)
        for number, (name, errors) in enumerate(errors_m.items()):
            look = _style(number) | {"label": labels[name]}
            for axes, sizes in ((left, horizontal(errors)), (right, vertical(errors))):
                values = np.maximum(sizes, SMALLEST_M)  # the error of a known height is 0
                axes.plot(np.quantile(values, _SHARES), _SHARES, **look)
                axes.plot(np.quantile(values, SHARES), SHARES, "o", ms=3.5, color=look["color"])
        for axes, kind in ((left, "horizontal"), (right, "vertical")):
            low = min(np.interp(0.03, line.get_ydata(), line.get_xdata()) for line in axes.lines)
            axes.set(xscale="log", ylim=(0.0, 1.0), xlabel=f"{kind} position error (m)")
            axes.set_xlim(left=low)
            axes.set_yticks(SHARES, [f"{100.0 * share:.0f} %" for share in SHARES])
            axes.set_ylabel("share of epochs with a smaller error")
            plain_numbers(axes.xaxis)
        legend_of(figure, right, width_mm, left.lines[::2])


def draw_consistency(
    time_s: Array, nees: Mapping[str, Array], dof: int, path: Path, width_mm: float | None = None
) -> None:
    """Draw the NEES over time with its chi-square bounds, and the distribution of the NEES.

    Args:
        time_s: (T,) times since the first epoch of an episode.
        nees: contender -> NEES (n, T) of n episodes; each value sums over ``dof`` coordinates.
        path, width_mm: arguments of :func:`~experiments.reporting.figures.canvas.panels`.
    """
    episodes = len(next(iter(nees.values())))
    low, high = chdtri(episodes * dof, [0.975, 0.025]) / (episodes * dof)
    with panels(path, 2, len(nees) + 2, width_mm) as (figure, (over_time, whole)):
        bounds = over_time.axhspan(low, high, color="0.7", lw=0.0, label=BOUNDS)
        whole.plot([0.0, 1.0], [0.0, 1.0], color="0.5", lw=4.0, alpha=0.6, label="consistent")
        names = contenders(nees)
        for number, (name, values) in enumerate(nees.items()):
            look = _style(number) | {"label": names[name]}
            over_time.plot(time_s, values.mean(axis=0) / dof, **look)
            inside = np.sort(chdtr(dof, values), axis=None)
            whole.plot(_SHARES, np.searchsorted(inside, _SHARES, "right") / inside.size, **look)
        label = f"mean NEES / {dof}, of {episodes:,} episodes"
        over_time.set(xlabel="time since the start (s)", yscale="log", ylabel=label)
        plain_numbers(over_time.yaxis)
        whole.set(xlabel="probability p", ylabel="share of NEES below\nthe chi-square p-quantile")
        whole.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
        legend_of(figure, whole, width_mm, [bounds, *whole.lines])


def draw_learning_curves(label: str, lines: Sequence[Line], path: Path) -> None:
    """Draw a quantity over training steps, with one line per training seed and a line at zero.

    ``label`` is the label of the y axis.
    """
    from matplotlib.ticker import EngFormatter, NullFormatter

    with panels(path, 1, 0, PHONE_MM) as (_, (axes,)):
        for steps, values in lines:
            axes.plot(steps, values, color="C0", lw=1.0, alpha=0.8)
        axes.axhline(0.0, color="black", lw=0.8)
        axes.set(xscale="log", xlabel="steps", ylabel=caption(label))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 500k, 2M
        axes.xaxis.set_minor_formatter(NullFormatter())
