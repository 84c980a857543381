"""Pictures of tracks: timelines of several, or one from above; with errors and modes (filters)."""

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from experiments.reporting.figures.curves import (
    NO_MODE,
    caption,
    contenders,
    legend_beside,
    picture,
)
from mmwave_env.localization.localizer import Track
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.history import History, ellipse

_LINES_IN = 2.0  # height of a panel with lines, inches
_LOOKS = [  # line colors (other than those of modes) and styles of contenders
    {"color": color, "ls": style}
    for color, style in (("C3", "-"), ("C4", "--"), ("C6", "-."), ("C2", ":"))
]
_TRUE = {"color": "0.55", "lw": 3.5, "alpha": 0.6}  # style of the line of the true speed


def mode_ribbon(axes: Any, time: Array, mode: Index, low: float = 0.0) -> None:
    """Draw a band of height 1 above ``low``, in the colors of the modes that ran.

    ``mode`` (T,) has the number of the mode that ran at each ``time`` (T,), or -1 if no mode ran.
    """
    begins = np.flatnonzero(np.diff(mode, prepend=-2))
    ends = np.append(begins[1:], len(mode) - 1)
    spans = np.stack([time[begins], time[ends] - time[begins]], axis=1)
    colors = [_color(number) for number in mode[begins]]
    axes.broken_barh(spans, (low, 1.0), facecolors=colors, lw=0.0)
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
        speeds.plot(time_s, first.true_mps[rows], label="true speed", **_TRUE)
        for look, (name, history) in zip(itertools.cycle(_LOOKS), histories.items(), strict=False):
            speeds.plot(time_s, history.speed_mps[rows], label=names[name], **look)
            errors.plot(time_s, history.error_m[rows], label=names[name], **look)
        labels = ((speeds, "estimated speed (m/s)"), (errors, "position error (m)"))
        for panel, label in labels:
            panel.set(ylabel=label, ylim=(0.0, None))
            legend_beside(panel)
        chosen = [history.modes[rows] for history in histories.values()]
        for row, mode in enumerate(chosen):
            mode_ribbon(axes, time_s, mode, low=-1.3 * row)
        axes.set_yticks([0.5 - 1.3 * row for row in range(len(chosen))], [*names.values()])
        axes.set_xlabel("time (s)")
        for number in np.unique(np.concatenate(chosen)).tolist():
            label = caption(modes[number]) if number >= 0 else "none"
            axes.plot([], [], "s", color=_color(number), label=label)
        legend_beside(axes)


def _color(mode: int) -> str:
    """Return the color of a mode, given its number; -1 if no mode ran."""
    return NO_MODE if mode < 0 else f"C{mode}"


POINTS = 6000  # maximum number of epochs in a picture; a longer track is thinned
ELLIPSES = 15  # maximum number of ellipses along a track
TITLE_LETTERS = 80  # maximum number of characters in a line of the title
_ENLARGED = (1, 2, 5, 10, 20, 50, 100)  # factors by which ellipses may be enlarged to be visible
_VISIBLE = 0.02  # smallest visible semi-axis of an ellipse, as a share of the track's extent


def draw_trajectory(track: Track, truth_m: Array, anchors_m: Array, path: Path, title: str) -> None:
    """Draw a track from above, its error over time, and its modes, if it has several.

    ``truth_m`` (T, 3) are the true positions, NaN where unknown. ``anchors_m`` (L, 3) are the
    anchors, the base station first.
    """
    shown = slice(None, None, -(-len(track) // POINTS))
    track = track.part(shown)
    truth_m = truth_m[shown]
    several = len(np.unique(track.mode)) > 1
    heights = (5.0, 1.8, 0.3) if several else (5.0, 1.8)
    with picture(path, 10.0, sum(heights) + 1.2) as figure:
        panels = figure.subplots(len(heights), 1, height_ratios=heights)
        _draw_above(panels[0], track, truth_m, anchors_m)
        time = track.time_s - track.time_s[0]
        seconds, unit = (3600.0, "h") if time[-1] > 3 * 3600.0 else (1.0, "s")
        time = time / seconds
        _draw_error(panels[1], track, truth_m, time)
        if several:
            panels[1].tick_params(labelbottom=False)
            panels[1].sharex(panels[2])
            mode_ribbon(panels[2], time, track.mode)
            panels[2].set_yticks([0.5], ["mode"])
        panels[-1].set_xlabel(f"time since the first epoch ({unit})")
        lines = textwrap.wrap(caption(title), TITLE_LETTERS, break_on_hyphens=False)
        figure.suptitle("\n".join(lines), x=0.02, ha="left")


def _draw_above(axes: Any, track: Track, truth_m: Array, anchors_m: Array) -> None:
    from matplotlib.collections import LineCollection

    position = track.smooth_x[:, :2]
    mode = track.mode
    steps = np.stack([position[:-1], position[1:]], axis=1)
    whole = np.diff(track.segment) == 0  # other steps join two segments
    if np.isfinite(truth_m).any():
        axes.plot(*truth_m[:, :2].T, color="black", alpha=0.25, label="truth", lw=4.0)
    for number in np.unique(mode):
        label = f"estimate, {caption(track.modes[number])}"
        chosen = steps[whole & (mode[1:] == number)]
        lines = LineCollection(chosen, color=_color(number), lw=1.4, label=label)
        axes.add_collection(lines)
    _draw_ellipses(axes, track)
    axes.plot(*position[0], "o", color="black", ms=5, label="start")
    draw_anchors(axes, position, anchors_m)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_adjustable("datalim")
    legend_beside(axes)


def _draw_ellipses(axes: Any, track: Track) -> None:
    """Draw 95 % ellipses at a few epochs, enlarged if they are too small to be visible."""
    at = np.unique(np.linspace(0, len(track.time_s) - 1, ELLIPSES).astype(int))
    covariance_m2 = track.smooth_P[at][:, [0, 1, 1, 2]].reshape(-1, 2, 2)  # of x and y
    deviations = np.sqrt(chdtri(2, 0.05))
    longest = deviations * np.sqrt(np.linalg.eigvalsh(covariance_m2)[:, 1])  # semi-axes
    extent = float(np.ptp(track.smooth_x[:, :2], axis=0).max())
    wanted = _VISIBLE * extent / max(float(np.median(longest)), 1e-9)
    enlarged = next((n for n in _ENLARGED if n >= wanted), _ENLARGED[-1])
    for center, P in zip(track.smooth_x[at, :2], covariance_m2, strict=True):
        axes.fill(*ellipse(center, P, enlarged * deviations).T, fc="none", ec="black", lw=0.8)
    label = "95 % ellipses" + (f",\nenlarged {enlarged} times" if enlarged > 1 else "")
    axes.plot([], [], "o", mfc="none", mec="black", mew=0.8, ms=8, label=label)


def draw_anchors(axes: Any, position: Array, anchors_m: Array) -> None:
    """Draw those anchors that are near the track: at most its extent, or 30 m, outside its box."""
    low = position.min(axis=0)
    high = position.max(axis=0)
    reach = max(float((high - low).max()), 30.0)
    middle = 0.5 * (low + high)
    for number, anchor in enumerate(anchors_m[:, :2], start=1):
        if ((anchor > low - reach) & (anchor < high + reach)).all():
            name = "gNB" if number == 1 else f"anchor {number}"
            marker, fill = ("^", "black") if number == 1 else ("v", "white")
            axes.plot(*anchor, marker, color="black", ms=8, mfc=fill)
            # In the right half, a name is to the left of its anchor, so that it is not cut off.
            offset, side = (-7, "right") if anchor[0] > middle[0] else (7, "left")
            place = {"textcoords": "offset points", "va": "center", "ha": side}
            axes.annotate(name, anchor, (offset, 0), **place)


def _draw_error(axes: Any, track: Track, truth_m: Array, time: Array) -> None:
    error = np.linalg.norm(track.smooth_x[:, :3] - truth_m, axis=1)
    sigma = np.sqrt(track.smooth_P[:, [0, 2, 5]].sum(axis=1))  # of x, y and z
    axes.fill_between(
        time, 0.0, 2.0 * sigma, color="C2", alpha=0.35, lw=0.0, label="2 standard deviations"
    )
    if np.isfinite(error).any():
        axes.plot(time, error, color="black", lw=0.8, label="error")
    axes.set(ylabel="position error (m)", ylim=(0.0, None))
    legend_beside(axes)
