"""Picture of a track from above, with its errors and modes (filters) over time."""

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri

from experiments.reporting.figures.curves import (
    caption,
    legend_beside,
    picture,
)
from mmwave_env.localization.localizer import Track
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.history import ellipse

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
            _draw_modes(panels[2], time, track.mode)
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
        lines = LineCollection(chosen, color=f"C{number}", lw=1.4, label=label)
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


def _draw_modes(axes: Any, time: Array, mode: Index) -> None:
    """Draw a band in the colors of the modes (T,) that ran at the times (T,)."""
    begins = np.flatnonzero(np.diff(mode, prepend=-1))
    ends = np.append(begins[1:], len(mode) - 1)
    spans = np.stack([time[begins], time[ends] - time[begins]], axis=1)
    axes.broken_barh(
        spans, (0.0, 1.0), facecolors=[f"C{number}" for number in mode[begins]], lw=0.0
    )
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.set_yticks([0.5], ["mode"])
