"""How trainings went, and what they came to."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures.canvas import (
    LEGEND_COLUMNS,
    caption,
    contenders,
    legend_of,
    line_with_band,
    panels,
    picture,
)

COLUMNS = 4  # of panels

Line = tuple[Sequence[float], Sequence[float]]  # steps, values


def draw_learning_curves(
    figures: Mapping[str, Mapping[str, Sequence[Line]]], path: Path, narrow: bool = False
) -> None:
    """Figures over steps, a line a training, as a picture.

    Args:
        figures: by what is shown (the label of the y axis) and run, steps and values of every
            training. Zero is drawn, too.
        path: .png, .svg or .pdf.
        narrow: whether the panels are below each other.
    """
    from matplotlib.ticker import EngFormatter, NullFormatter

    runs = list(dict.fromkeys(run for table in figures.values() for run in table))
    labels = contenders(runs)
    with panels(path, len(figures), len(runs), narrow) as (figure, axes_of):
        handles = {}
        for axes, (what, table) in zip(axes_of, figures.items(), strict=True):
            for run, lines in table.items():
                look = {"color": f"C{runs.index(run)}", "lw": 1.0, "alpha": 0.8}
                for steps, values in lines:
                    (handles[run],) = axes.plot(steps, values, label=labels[run], **look)
            axes.axhline(0.0, color="black", lw=0.8)
            axes.set(xscale="log", xlabel="steps", ylabel=caption(what))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 500k, 2M
            axes.xaxis.set_minor_formatter(NullFormatter())
        legend_of(figure, axes_of[-1], narrow, [*handles.values()])


def draw_profiles(trained: Mapping[str, Any], path: Path) -> None:
    """Performance profiles as a picture: how often runs gain more than so much, a panel a rival.

    Args:
        trained: by run, figures of :class:`~experiments.evaluation.training_seeds.TrainingSeeds`
            as results hold them.
        path: .png, .svg or .pdf.
    """
    rivals = contenders(dict.fromkeys(rival for run in trained.values() for rival in run["minus"]))
    labels, columns = contenders(trained), min(COLUMNS, len(rivals))
    rows = -(-len(rivals) // columns)
    with picture(path, 1.0 + 3.2 * columns, 0.6 + 2.9 * rows) as figure:
        grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
        for axes in grid.flat[len(rivals) :]:
            axes.remove()
        for axes, (rival, shown) in zip(grid.flat, rivals.items(), strict=False):
            for number, (name, run) in enumerate(trained.items()):
                profile = run["minus"][rival]["profile"]
                band = np.array([profile[line] for line in ("share", "low", "high")])
                levels = np.asarray(profile["above"])
                line_with_band(axes, levels, band, color=f"C{number}", label=labels[name])
            axes.axvline(0.0, color="black", lw=0.8)
            axes.axhline(0.5, color="black", lw=0.8, ls=":")
            axes.set(title=f"against {shown}", ylim=(0.0, 1.0))
            axes.margins(x=0.0)
        figure.supxlabel("reward more than the rival's by", fontsize="medium")
        figure.supylabel("share of seeds and episodes", fontsize="medium")
        handles, names = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper left", ncols=LEGEND_COLUMNS)
