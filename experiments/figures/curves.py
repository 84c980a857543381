"""How trainings went, and what they came to."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.evaluation.training_seeds import TrainingSeeds
from experiments.figures.canvas import caption, contenders, legend_beside, line_with_band, picture

COLUMNS = 4  # of panels

Line = tuple[Sequence[float], Sequence[float]]  # steps, values


def draw_learning_curves(panels: Mapping[str, Mapping[str, Sequence[Line]]], path: Path) -> None:
    """A figure over steps, a line a training, as a picture.

    Args:
        panels: by what is shown (the label of the y axis) and run, steps and values of every
            training. Zero is drawn, too.
        path: .png, .svg or .pdf.
    """
    from matplotlib.ticker import EngFormatter, NullFormatter

    with picture(path, 2.2 + 4.6 * len(panels), 4.2) as figure:
        (row,) = figure.subplots(1, len(panels), squeeze=False)
        for axes, (what, runs) in zip(row, panels.items(), strict=True):
            labels = contenders(runs)
            for number, (run, lines) in enumerate(runs.items()):
                label = labels[run]
                for steps, values in lines:
                    axes.plot(steps, values, color=f"C{number}", lw=1.0, alpha=0.8, label=label)
                    label = ""
            axes.axhline(0.0, color="black", lw=0.8)
            axes.set(xscale="log", xlabel="steps", ylabel=caption(what))
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))  # 500k, 2M
            axes.xaxis.set_minor_formatter(NullFormatter())
        legend_beside(row[-1])


def draw_profiles(found: Sequence[TrainingSeeds], path: Path) -> None:
    """Performance profiles as a picture: how often runs gain more than so much, a panel a rival."""
    panels = list(found[0].minus)
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    with picture(path, 1.0 + 3.2 * columns, 0.6 + 2.9 * rows) as figure:
        grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.remove()
        labels, rivals = contenders(one.run.name for one in found), contenders(panels)
        for axes, rival in zip(grid.flat, panels, strict=False):
            for number, one in enumerate(found):
                profile = one.minus[rival]
                line_with_band(axes, profile.levels, profile.above, color=f"C{number}",
                               label=labels[one.run.name])  # fmt: skip
            axes.axvline(0.0, color="black", lw=0.8)
            axes.axhline(0.5, color="black", lw=0.8, ls=":")
            axes.set(title=f"against {rivals[rival]}", ylim=(0.0, 1.0))
            axes.margins(x=0.0)
        figure.supxlabel("reward more than the rival's by", fontsize="medium")
        figure.supylabel("share of seeds and episodes", fontsize="medium")
        handles, _ = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, [*labels.values()], loc="outside upper left", ncols=2)
