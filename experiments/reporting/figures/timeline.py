"""Timelines of speeds, errors and the modes (filters) that ran."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reporting.figures.canvas import (
    NO_MODE,
    caption,
    contenders,
    legend_beside,
    picture,
)
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.history import History

_LINES_IN = 2.0  # height of a panel with lines, inches
_LOOKS = [  # line colors (other than those of modes) and styles of contenders
    {"color": color, "ls": style}
    for color, style in (("C3", "-"), ("C4", "--"), ("C6", "-."), ("C2", ":"))
]
_TRUE = {"color": "0.55", "lw": 3.5, "alpha": 0.6}  # style of the line of the true speed


def mode_ribbon(axes: Any, time: Array, mode: Index, modes: int, low: float = 0.0) -> None:
    """Draw a band of height 1 above ``low``, in the colors of the modes that ran.

    ``mode`` (T,) has the number of the mode that ran at each ``time`` (T,), or -1 if no mode ran.
    """
    begins = np.flatnonzero(np.diff(mode, prepend=-2))
    ends = np.append(begins[1:], len(mode) - 1)
    for number in range(-1, modes):
        chosen = mode[begins] == number
        spans = list(zip(time[begins[chosen]], (time[ends] - time[begins])[chosen], strict=True))
        color = NO_MODE if number < 0 else f"C{number}"
        axes.broken_barh(spans, (low, 1.0), facecolors=color, lw=0.0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(axis="y", length=0)


def draw_histories(
    histories: Mapping[str, History], modes: Sequence[str], rows: slice, path: Path
) -> None:
    """Draw speeds, errors and modes of contenders during a part of an episode.

    ``rows`` selects rows of the histories: row 0 is the prior, and row 1 is the first epoch.
    """
    first = next(iter(histories.values()))
    time_s = first.time_s[rows]
    ribbons = max(0.45 * len(histories), 0.2 * len(modes))
    names = contenders(histories)
    heights = (_LINES_IN, _LINES_IN, ribbons)
    with picture(path, 9.0, 1.0 + sum(heights)) as figure:
        speeds, errors, axes = figure.subplots(3, sharex=True, height_ratios=heights)
        speeds.plot(time_s, _speed_mps(first.truth[rows]), label="true speed", **_TRUE)
        for look, (name, history) in zip(itertools.cycle(_LOOKS), histories.items(), strict=False):
            speeds.plot(time_s, _speed_mps(history.estimate[rows]), label=names[name], **look)
            errors.plot(time_s, history.error_m[rows], label=names[name], **look)
        labels = ((speeds, "estimated speed (m/s)"), (errors, "position error (m)"))
        for panel, label in labels:
            panel.set(ylabel=label, ylim=(0.0, None))
            legend_beside(panel)
        chosen = [history.modes[rows] for history in histories.values()]
        for row, mode in enumerate(chosen):
            mode_ribbon(axes, time_s, mode, len(modes), low=-1.3 * row)
        axes.set_yticks([0.5 - 1.3 * row for row in range(len(chosen))], [*names.values()])
        axes.set_xlabel("time (s)")
        for number in np.unique(np.concatenate(chosen)).tolist():
            color = NO_MODE if number < 0 else f"C{number}"
            label = caption(modes[number]) if number >= 0 else "none"
            axes.plot([], [], "s", color=color, label=label)
        legend_beside(axes)


def _speed_mps(states: Array) -> Array:
    """Return the speeds (T,) of states (T, 6 or more) that begin with position and velocity."""
    return np.linalg.norm(states[:, 3:6], axis=1)  # type: ignore[no-any-return]
