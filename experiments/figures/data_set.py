"""A data set from above, its speed, and which anchor was seen when."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures.canvas import caption, picture
from experiments.figures.timeline import mode_ribbon
from experiments.figures.trajectory import draw_anchors, time_unit
from mmwave_env.numerics.arrays import Array, Mask

_RIBBON_IN = 0.28  # height of an anchor's, inches


def draw_data_set(
    rows: Array, anchors_m: Array, path: Path, title: str, timed: bool = True
) -> None:
    """A data set as a picture.

    Args:
        rows: (n, 4 + L) time, position (NaN where not known), and whether each anchor was seen.
        anchors_m: (L, 3), the base station first.
        path: .png, .svg or .pdf.
        title: of the picture.
        timed: whether times are seconds; else they are numbers.
    """
    anchors = len(anchors_m)
    heights = [5.0, *([_RIBBON_IN * anchors] if anchors else [])]
    seconds, unit = time_unit(rows[:, 0])
    time = (rows[:, 0] - rows[0, 0]) / seconds
    with picture(path, 10.0, sum(heights) + 1.4) as figure:
        above, *ribbons = figure.subplots(len(heights), 1, height_ratios=heights, squeeze=False)[
            :, 0
        ]
        label = f"time since the first epoch ({unit})" if timed else "number"
        _draw_above(above, figure, rows, time, anchors_m, label)
        for axes in ribbons:
            _draw_seen(axes, time, rows[:, 4:] > 0.0)
            axes.set_xlabel(f"time since the first epoch ({unit})")
        figure.suptitle(caption(title), x=0.02, ha="left")


def _draw_above(
    axes: Any, figure: Any, rows: Array, time: Array, anchors_m: Array, label: str
) -> None:
    position = rows[:, 1:3]
    dots = axes.scatter(*position.T, c=time, s=6.0, cmap="viridis", lw=0.0)
    figure.colorbar(dots, ax=axes, label=label, shrink=0.7)
    known = position[np.isfinite(position).all(axis=1)]
    if len(known):
        axes.plot(*known[0], "o", mfc="none", mec="black", ms=7)
        axes.annotate("start", known[0], (7, 5), textcoords="offset points")
        draw_anchors(axes, known, anchors_m)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_adjustable("datalim")


def _draw_seen(axes: Any, time: Array, seen: Mask) -> None:
    """A ribbon an anchor, colored where it was seen."""
    for anchor, there in enumerate(seen.T):
        mode_ribbon(axes, time, np.where(there, 0, -1), 1, low=-1.25 * anchor)
    axes.set_yticks(
        [0.5 - 1.25 * a for a in range(seen.shape[1])],
        [f"anchor {a + 1}" for a in range(seen.shape[1])],
    )
