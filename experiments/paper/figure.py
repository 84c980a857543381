"""Picture of Tables I and II and of the ATE against process noise."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.evaluation.intervals import Interval
from experiments.paper.printed import Cell, Section
from experiments.reporting.figures.canvas import picture, plain_numbers
from mmwave_env.models.radio import TUNED_RADIOS

COUPLED = 3  # column of our ATE with coupled process noise; column 1 has the paper's ATE
FILTERS = 4  # number of rows of the paper's tables; our tables begin with the same rows
COLORS = {"ekf": "C0", "ukf": "C1"}


def _errorbars(axes: Any, x: Sequence[float], cells: Sequence[Cell], **style: Any) -> None:
    intervals = [
        (c.mean, c.mean - c.low, c.high - c.mean) for c in cells if isinstance(c, Interval)
    ]
    y, *spread = zip(*intervals, strict=True)
    axes.errorbar(x, y, yerr=spread, capsize=2, **style)


def _meters(axes: Any) -> None:
    """Make the y axis a logarithmic axis of ATE, with the same limits in every panel."""
    axes.set_yscale("log")
    axes.set_ylim(0.1, 1000.0)
    plain_numbers(axes.yaxis)
    axes.set_ylabel("ATE (m)")


def _bars(axes: Any, sections: Sequence[Section], title: str) -> None:
    """Draw the ATE of each filter: the paper's value, and our value for each radio profile."""
    rows = sections[0].rows[:FILTERS]
    axes.scatter(
        range(FILTERS), [row[1] for row in rows], marker="_", s=900, color="black", label="paper"
    )
    for offset, radio, section in zip((-0.2, 0.0, 0.2), TUNED_RADIOS, sections, strict=True):
        cells = [row[COUPLED] for row in section.rows[:FILTERS]]
        x = [i + offset for i in range(FILTERS)]
        _errorbars(axes, x, cells, fmt="o", markersize=4, label=radio)
    axes.set_xticks(range(FILTERS), [str(row[0]).replace(" ", "\n") for row in rows])
    _meters(axes)
    axes.set_title(title)
    axes.grid(visible=False, axis="x")


def _sweep(axes: Any, section: Section) -> None:
    """Draw the ATE against the process noise, with and without gates."""
    x = [float(str(row[0])) for row in section.rows]
    styles = {"no gates": ":", "gates, no recovery": "-", "gates, recovery": "--"}
    for column, name in enumerate(section.columns[1:], start=1):
        algorithm, gates = name.split(", ", 1)
        style = {"color": COLORS[algorithm.lower()], "linestyle": styles[gates]}
        _errorbars(axes, x, [row[column] for row in section.rows], label=name, **style)
    axes.set_xscale("log")
    plain_numbers(axes.xaxis)
    axes.set_xlabel("process noise sigma_v (m/s)")
    _meters(axes)
    axes.set_title("Vehicle, standard: process noise")
    axes.legend(loc="lower left")


def draw(sections: dict[str, Section], path: Path) -> None:
    """Draw all panels from the sections, whose keys are titles; write the picture to a file."""
    with picture(path, 13.0, 4.2) as figure:
        axes = figure.subplots(1, 3)
        for panel, title in zip(axes, ("Table I: pedestrian", "Table II: vehicle"), strict=False):
            _bars(panel, [sections[f"{title}, {radio}"] for radio in TUNED_RADIOS], title)
        axes[0].legend(markerscale=0.6)
        _sweep(axes[2], sections["Vehicle ATE against process noise, m"])
