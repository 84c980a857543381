"""A picture of a track: from above, and its error and standard deviation over time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmwave_env.files import atomic_path
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.numerics.arrays import Array

_POINTS = 6000  # kept of a track of any length, at least half of them
# of the modes, over and over; told apart by color-blind people, too
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442")
_DIAGONAL = [0, 2, 5]  # of the position in a packed covariance


class TrackPicture:
    """Every n-th epoch of a track, with n as the length of the track demands.

    Args:
        modes: their names.
        anchors_m: (L, 3), the physical gNB first.
    """

    def __init__(self, modes: Sequence[str], anchors_m: Array) -> None:
        self._modes, self._anchors_m = list(modes), anchors_m
        self._kept = np.empty((0, 10))  # time, mode, position, true position, sigma, segment
        self._every, self._epochs = 1, 0

    def add(self, block: TrackBlock, truth: Array | None) -> None:
        """Take a block and its true positions (T, 3), NaN where not known."""
        if truth is None:
            truth = np.full((len(block), 3), np.nan)
        sigma = np.sqrt(np.maximum(block.smooth_P[:, _DIAGONAL], 0.0).sum(axis=1))
        segment = np.full(len(block), block.segment)
        rows = np.column_stack(
            [block.time_s, block.mode, block.smooth_x[:, :3], truth, sigma, segment]
        )
        self._kept = np.concatenate([self._kept, rows[-self._epochs % self._every :: self._every]])
        self._epochs += len(rows)
        while len(self._kept) > _POINTS:
            self._kept, self._every = self._kept[::2], 2 * self._every

    def save(self, path: Path, title: str) -> None:
        """Draw it as PNG, in one step."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10.0, 8.0), layout="constrained")
        FigureCanvasAgg(figure)
        above, over_time = figure.subplots(2, 1, height_ratios=(5, 2))
        self._draw_above(above)
        self._draw_over_time(over_time)
        figure.suptitle(title)
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=120)

    def _draw_above(self, axes: Any) -> None:
        from matplotlib.collections import LineCollection

        mode, position, truth = self._kept[:, 1], self._kept[:, 2:4], self._kept[:, 5:7]
        # Lines between epochs far apart would cross where nobody went.
        style = {"ls": "-"} if self._every == 1 else {"ls": "", "marker": ".", "ms": 2.0}
        if np.isfinite(truth).any():
            axes.plot(*truth.T, color="black", lw=3.0, alpha=0.3, label="truth",
                      **style if self._every == 1 else style | {"ms": 5.0})  # fmt: skip
        steps = np.stack([position[:-1], position[1:]], axis=1)
        whole = np.diff(self._kept[:, 9]) == 0.0  # where the track begins anew, no line leads there
        for number in np.unique(mode).astype(int):
            color, label = _COLORS[number % len(_COLORS)], f"estimate, {self._modes[number]}"
            if self._every == 1:
                axes.add_collection(
                    LineCollection(steps[whole & (mode[1:] == number)], color=color, lw=1.2)
                )
                axes.plot([], [], color=color, lw=1.2, label=label)
            else:
                axes.plot(*position[mode == number].T, color=color, label=label, **style)
        axes.plot(*position[0], "o", color="black", ms=5, label="start")
        self._draw_anchors(axes, position)
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.set_adjustable("datalim")
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False,
                    markerscale=1.0 if self._every == 1 else 2.0)  # fmt: skip

    def _draw_anchors(self, axes: Any, position: Array) -> None:
        """Those no further from the track than the track is long."""
        low, high = position.min(axis=0), position.max(axis=0)
        reach = max(float((high - low).max()), 30.0)
        middle = 0.5 * (low + high)
        for number, anchor in enumerate(self._anchors_m[:, :2], start=1):
            if ((anchor > low - reach) & (anchor < high + reach)).all():
                name = "gNB" if number == 1 else f"virtual anchor {number}"
                axes.plot(*anchor, "^" if number == 1 else "v", color="black", ms=8,
                          mfc="black" if number == 1 else "white")  # fmt: skip
                right = anchor[0] > middle[0]  # so that the name points into the picture
                axes.annotate(name, anchor, (-7 if right else 7, 0), textcoords="offset points",
                              va="center", ha="right" if right else "left")  # fmt: skip

    def _draw_over_time(self, axes: Any) -> None:
        time, sigma = self._kept[:, 0] - self._kept[0, 0], self._kept[:, 8]
        error = np.linalg.norm(self._kept[:, 2:5] - self._kept[:, 5:8], axis=1)
        unit, seconds = ("h", 3600.0) if time[-1] > 3 * 3600.0 else ("s", 1.0)
        if np.isfinite(error).any():
            axes.plot(time / seconds, error, color="black", lw=0.8, label="error")
        axes.plot(time / seconds, sigma, color="#009e73", lw=1.2, label="standard deviation")
        axes.set(xlabel=f"time since the first epoch ({unit})", ylabel="position error (m)",
                 ylim=(0.0, None))  # fmt: skip
        axes.margins(x=0.01)
        axes.grid(alpha=0.3)
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
