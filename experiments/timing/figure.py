"""The benchmark as a picture: rates over the number of environments, and limits of the core."""

from pathlib import Path
from statistics import median
from typing import Any

from experiments.figures.canvas import picture, plain_numbers
from experiments.timing.measured import Measured
from experiments.timing.report import label, limited
from experiments.timing.workloads import CARTPOLES, SYNC, SYNC_NAME, THREADS


def draw(measured: Measured, path: Path) -> None:
    """Write it."""
    with picture(path, 12.0, 4.6) as figure:
        rates, limits = figure.subplots(1, 2)
        _draw_rates(rates, measured)
        _draw_limits(limits, measured)


def _draw_rates(axes: Any, measured: Measured) -> None:
    for threads, color in zip(THREADS, ("C0", "C1"), strict=True):
        rates = [measured.rates[name] for name in measured.natives(threads)]
        _line(axes, measured.sizes, [one.steps_per_s for one in rates], color=color, marker="o",
              label=f"native, {threads} thread{'s' * (threads > 1)}")  # fmt: skip
        _line(axes, measured.sizes, [one.between_ends for one in rates], color=color, ls=":",
              label=f"between ends of episodes, {threads} thread{'s' * (threads > 1)}")  # fmt: skip
    points = {"filterpy": (1, "s"), "single": (1, "D"), SYNC_NAME: (SYNC, "^"),
              "cartpole": (1, "x"), f"cartpole_{CARTPOLES}": (CARTPOLES, "x")}  # fmt: skip
    for name, (n, marker) in points.items():
        _line(axes, [n], [measured.rates[name].steps_per_s], color="black", marker=marker,
              mfc="gray" if "cartpole" in name else "black", ls="", label=label(name))  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="environments N", ylabel="steps per second",
             title="Steps per second")  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        plain_numbers(axis)
    axes.legend(fontsize="x-small")


def _line(axes: Any, x: list[int], rounds: list[list[float]], **style: Any) -> None:
    """Medians with the range of the rounds."""
    y = [median(values) for values in rounds]
    below = [middle - min(values) for middle, values in zip(y, rounds, strict=True)]
    above = [max(values) - middle for middle, values in zip(y, rounds, strict=True)]
    axes.errorbar(x, y, yerr=[below, above], capsize=2, ms=5, **style)


def _draw_limits(axes: Any, measured: Measured) -> None:
    """Time a step of one thread takes, and what the core needs at least."""
    found = limited(measured)
    limits, taken = (
        [1e9 * median(values) for values in column] for column in zip(*found.values(), strict=True)
    )
    axes.hlines(list(found), limits, taken, color="#cccccc", lw=4.0)
    axes.plot(limits, list(found), "|", color="C4", ms=12, mew=3, label="limit of the core")
    axes.plot(taken, list(found), "o", color="black", ms=5, label="taken")
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="ns a step, one thread", title="Limit of the core")
    plain_numbers(axes.xaxis)
    axes.grid(visible=False, axis="y")
    axes.legend(fontsize="x-small")
