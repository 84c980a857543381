"""Learning curves of trainings."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.figures.canvas import (
    caption,
    contenders,
    legend_of,
    panels,
)

Line = tuple[Sequence[float], Sequence[float]]  # steps, values


def draw_learning_curves(
    figures: Mapping[str, Mapping[str, Sequence[Line]]], path: Path, narrow: bool = False
) -> None:
    """Draw figures over steps as a picture, with a line per training.

    Args:
        figures: steps and values of every training, by the label of the y axis and by run. A line
            marks zero.
        path: .png, .svg or .pdf file.
        narrow: whether the panels are stacked.
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
