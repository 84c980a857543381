"""Which mode ran when, and what came of it."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures.canvas import NO_MODE, caption, contenders, legend_beside, picture
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.history import History

_LINES_IN = 2.0  # height of a panel of lines, inches
_COLORS, _STYLES = ("C3", "C4", "C6", "C2"), ("-", "--", "-.", ":")  # not those of the first modes
_OTHER = {"color": "0.55", "lw": 3.5, "alpha": 0.6}  # lies below narrower lines, which it shows


def mode_ribbon(axes: Any, time: Array, mode: Index, modes: int, low: float = 0.0) -> None:
    """A band of height 1 above ``low``, in the colors of the modes that ran.

    Args:
        axes: to draw into.
        time: (T,) of the epochs.
        mode: (T,) numbers; -1 for none.
        modes: how many there are.
        low: where it begins.
    """
    begins = np.flatnonzero(np.diff(mode, prepend=-2))
    ends = np.append(begins[1:], len(mode) - 1)
    for number in range(-1, modes):
        some = mode[begins] == number
        spans = list(zip(time[begins[some]], (time[ends] - time[begins])[some], strict=True))
        color = NO_MODE if number < 0 else f"C{number}"
        axes.broken_barh(spans, (low, 1.0), facecolors=color, lw=0.0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(axis="y", length=0)


def draw_timeline(
    time_s: Array,
    chosen: Mapping[str, Index],
    modes: Sequence[str],
    path: Path,
    above: Mapping[str, Mapping[str, Array]] | None = None,
) -> None:
    """Modes over time as a picture, a ribbon a contender, and what goes with them above.

    Args:
        time_s: (T,) of the epochs.
        chosen: (T,) numbers of modes by contender; -1 for none.
        modes: their names.
        path: .png, .svg or .pdf.
        above: panels by what they show, with its unit; in each values (T,) by name. A contender
            has one color in all of them; others, such as the truth, are gray.
    """
    panels, ribbons = above or {}, max(0.45 * len(chosen), 0.2 * len(modes))
    heights = [*([_LINES_IN] * len(panels)), ribbons]
    with picture(path, 9.0, 1.0 + sum(heights)) as figure:
        rows = figure.subplots(len(heights), sharex=True, squeeze=False, height_ratios=heights)
        *lines, axes = rows[:, 0]
        colors, dashes = itertools.cycle(_COLORS), itertools.cycle(_STYLES)
        shown = contenders(chosen)
        styles = {name: {"color": next(colors), "ls": next(dashes)} for name in chosen}
        for panel, (title, values) in zip(lines, panels.items(), strict=True):
            for name, one in values.items():
                label = shown.get(name) or caption(name)
                panel.plot(time_s, one, label=label, **styles.get(name, _OTHER))
            panel.set(ylabel=caption(title), ylim=(0.0, None))
            legend_beside(panel)
        _draw_ribbons(axes, time_s, chosen, modes)


def draw_histories(
    histories: Mapping[str, History], modes: Sequence[str], rows: slice, path: Path
) -> None:
    """A part of an episode as contenders go through it, as a picture: speeds, errors, modes.

    Args:
        histories: of one and the same episode, by contender.
        modes: their names, the same for all.
        rows: the part: epochs, counted from 1, for the first row of a history is the prior's.
        path: .png, .svg or .pdf.
    """
    true = next(iter(histories.values()))
    believed = {name: one.speed_mps[1][rows] for name, one in histories.items()}
    draw_timeline(
        true.time_s[rows],
        {name: one.modes[rows] for name, one in histories.items()},
        modes,
        path,
        above={
            "estimated speed (m/s)": {"true speed": true.speed_mps[0][rows], **believed},
            "position error (m)": {name: one.error_m[rows] for name, one in histories.items()},
        },
    )


def _draw_ribbons(
    axes: Any, time_s: Array, chosen: Mapping[str, Index], modes: Sequence[str]
) -> None:
    for row, mode in enumerate(chosen.values()):
        mode_ribbon(axes, time_s, mode, len(modes), low=-1.3 * row)
    axes.set_yticks([0.5 - 1.3 * row for row in range(len(chosen))], [*contenders(chosen).values()])
    axes.set_xlabel("time (s)")
    there = {-1: "none", **dict(enumerate(modes))}
    ran = np.unique(np.concatenate(list(chosen.values())))
    for number in ran.tolist():
        color = NO_MODE if number < 0 else f"C{number}"
        axes.plot([], [], "s", color=color, label=caption(there[number]))
    legend_beside(axes)
