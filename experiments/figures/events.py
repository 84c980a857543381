"""What contenders choose around events, such as stops, and how far off they are there."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.evaluation.decisions import Decisions
from experiments.figures.canvas import (
    contenders,
    legend_beside,
    line_with_band,
    lines_of,
    picture,
    stacked_shares,
)
from mmwave_env.numerics.arrays import Array

SAME_SHARE = 0.02  # policies whose shares are nowhere further apart are one row
SAME_ERROR = 0.08  # lines that are nowhere further apart, of the height of the panel, are one
FAR_M, LINEAR_M = 15.0, 1.0  # beyond the one, differences beyond the other are compressed
LEGEND_LETTERS, ROW_LETTERS = 30, 22
_STYLES = ("-", "--", "-.", ":")  # beside the color


class Shares(NamedTuple):
    """A row of panels: of each kind of event the shares (k, w) of k modes by name."""

    title: str
    names: Sequence[str]
    by_event: Mapping[str, Array]


class Lines(NamedTuple):
    """A row of panels: of each kind of event a line with its band (3, w) by label.

    Attributes:
        compressed: large numbers lie closer, so that small ones of both signs are seen beside them.
    """

    title: str
    by_event: Mapping[str, Mapping[str, Array]]
    compressed: bool = False


def draw_around_events(
    time_s: Array, events: Mapping[str, int], shares: Sequence[Shares], lines: Lines, path: Path
) -> None:
    """Shares of modes above lines, a column a kind of event, as a picture.

    Args:
        time_s: (w,) of epochs around an event.
        events: how many there are of each kind.
        shares, lines: rows of panels.
        path: .png, .svg or .pdf.
    """
    labels = list(next(iter(lines.by_event.values())))
    letters = sum(label.count("\n") + 1 for label in labels)
    heights = [*(max(1.5, 0.25 + 0.2 * len(row.names)) for row in shares),
               max(2.6, 0.3 + 0.19 * letters)]  # fmt: skip
    width = 2.6 + 3.9 * max(2.0, 0.75 * len(events))
    with picture(path, width, 0.8 + sum(heights)) as figure:
        panels = figure.subplots(
            len(heights), len(events), sharex=True, sharey="row", squeeze=False,
            height_ratios=heights,
        )  # fmt: skip
        for column, (kind, count) in zip(panels.T, events.items(), strict=True):
            for axes, row in zip(column, shares, strict=False):
                stacked_shares(axes, time_s, row.by_event[kind], row.names)
            for number, (label, band) in enumerate(lines.by_event[kind].items()):
                style = _STYLES[number % len(_STYLES)]
                line_with_band(column[-1], time_s, band, color=f"C{number}", ls=style, label=label)
            column[-1].axhline(0.0, color="0.5", lw=0.8)
            for axes in column:
                axes.axvline(0.0, color="black", lw=0.8)
                axes.margins(x=0.0)
                if not count:
                    axes.set_xlim(time_s[0], time_s[-1])
                    axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center")
            column[0].set_title(f"{count:,} {kind}s")
            column[-1].set_xlabel(f"time since the {kind} (s)")
        if not any(events.values()):
            panels[-1, 0].set_ylim(-1.0, 1.0)
        if lines.compressed:
            _compress(panels[-1, 0])
        titles = [*(row.title for row in shares), lines.title]
        for axes, title in zip(panels[:, 0], titles, strict=True):
            axes.set_ylabel(title)
        for axes in panels[:, -1]:  # of shares in the order in which they lie
            legend_beside(axes, reverse=axes is not panels[-1, -1])
        figure.align_ylabels(panels[:, 0])


def _compress(axes: Any) -> None:
    low, high = axes.get_ylim()
    axes.set_yscale("asinh", linear_width=LINEAR_M)
    sizes = [digit * 10.0**power for power in range(6) for digit in (1.0, 2.0, 5.0)]
    axes.set_yticks([at for at in (*(-s for s in sizes), 0.0, *sizes) if low <= at <= high])
    axes.yaxis.set_major_formatter(lambda meters, _: f"{meters:+g}" if meters else "0")
    axes.set_ylim(low, high)


def draw_decisions(found: Decisions, path: Path) -> None:
    """Modes that policies choose around stops and pull-aways, and errors minus the reference's.

    Policies that choose alike share a row, and those that are as far off a line.
    """
    kinds, shown = list(found.around), contenders(next(iter(found.around.values())))
    every = {name: np.stack([found.shares(k, name) for k in kinds]) for name in found.actions}
    rows = []
    for modes in dict.fromkeys(map(tuple, found.actions.values())):
        same = {
            name: every[name] for name, actions in found.actions.items() if (*actions,) == modes
        }
        for names in alike(same, SAME_SHARE):
            title = "\n".join(["modes of", *lines_of([shown[n] for n in names], ROW_LETTERS)])
            rows.append(Shares(title, modes, dict(zip(kinds, every[names[0]], strict=True))))
    events = {kind: next(iter(table.values())).events for kind, table in found.around.items()}
    draw_around_events(found.time_s, events, rows, _differences(found, shown), path)


def _differences(found: Decisions, shown: Mapping[str, str]) -> Lines:
    """Errors minus the reference's; of the reference alone, its errors. Names as they are shown."""
    bands = {kind: found.minus(kind) for kind in found.around}
    title = f"position error minus\n{shown[found.reference]}'s (m)"
    if not bands["stop"]:
        title, alone = "mean position error (m)", found.reference
        for kind, table in found.around.items():
            bands[kind] = {alone: np.stack([table[alone].mean_error_m] * 3)}
    means = {n: np.stack([bands[kind][n][0] for kind in bands]) for n in bands["stop"]}
    largest = float(abs(np.nan_to_num([*means.values()])).max())
    compressed = largest > FAR_M
    if compressed:
        means = {name: np.arcsinh(mean / LINEAR_M) for name, mean in means.items()}
    height = np.ptp(np.nan_to_num([0.0 * next(iter(means.values())), *means.values()]))
    groups = alike(means, SAME_ERROR * float(height))
    labels = ["\n".join(lines_of([shown[n] for n in names], LEGEND_LETTERS)) for names in groups]
    firsts = [names[0] for names in groups]
    return Lines(
        title,
        {
            kind: {label: table[name] for label, name in zip(labels, firsts, strict=True)}
            for kind, table in bands.items()
        },
        compressed,
    )


def alike(values: Mapping[str, Array], tolerance: float) -> list[list[str]]:
    """Names in groups whose values are nowhere further than the tolerance from its first's."""
    groups: list[list[str]] = []
    for name, one in values.items():
        for group in groups:
            if not (abs(values[group[0]] - one) > tolerance).any():
                group.append(name)
                break
        else:
            groups.append([name])
    return groups
