"""Stanford diagrams: errors against the protection levels that should bound them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.positions import percent
from experiments.figures.canvas import caption, contenders, picture, plain_numbers
from mmwave_env.localization.position_errors import PositionErrors
from mmwave_env.localization.protection import Region, regions
from mmwave_env.numerics.arrays import Array, Index

_COLUMNS, _PANEL_IN = 4, 3.1
_CELLS = 60  # of a panel, along each axis
_ABOVE, _BELOW = 20.0, 100.0  # axes reach that far from the alert limit at least
_OUTSIDE = 0.002  # of the epochs: they may lie below an axis, which then counts them at its end
_LEAST_M = 1e-3


def edges_of(rows: Iterable[Array], limit_m: float) -> Array:
    """Edges (cells + 1,) of cells on a logarithmic axis, for errors and for levels, m.

    Args:
        rows: each errors and levels (n, 2), m.
        limit_m: alert limit.
    """
    finite = [one[np.isfinite(one).all(axis=1)] for one in rows]
    low = min([np.quantile(one, _OUTSIDE) for one in finite if len(one)], default=np.inf)
    high = max([one.max() for one in finite if len(one)], default=0.0)
    ends = max(min(low, limit_m / _BELOW), _LEAST_M), max(high, limit_m * _ABOVE)
    return np.geomspace(*ends, _CELLS + 1)


def counts_of(rows: Array, edges: Array) -> Index:
    """How many errors and levels (n, 2) lie in each cell (levels, errors).

    Those outside, or no numbers, count in the first or the last cell.
    """
    inside = np.clip(np.nan_to_num(rows, nan=np.inf), edges[0], edges[-1])
    counts, *_ = np.histogram2d(inside[:, 1], inside[:, 0], [edges, edges])
    return counts.astype(np.intp)


def draw_stanford(errors: Mapping[str, PositionErrors], limit_m: float, path: Path) -> None:
    """How often errors and levels are so large, as a picture, with the regions that matter.

    Args:
        errors: by contender, or by track; each kind of them gets a panel.
        limit_m: alert limit.
        path: .png, .svg or .pdf.
    """
    shown, kinds = contenders(errors), next(iter(errors.values())).kinds
    panels = {
        f"{shown[name]}, {kind}": errors[name].kinds[kind].rows()
        for kind in kinds for name in errors
    }  # fmt: skip
    edges = edges_of(panels.values(), limit_m)
    counts = {title: counts_of(rows, edges) for title, rows in panels.items()}
    most = max(int(count.max()) for count in counts.values())
    columns = min(_COLUMNS, len(panels) if len(errors) == 1 else len(errors))
    lines = -(-len(panels) // columns)
    with picture(path, 1.2 + _PANEL_IN * columns, 0.3 + _PANEL_IN * lines) as figure:
        figure.set_layout_engine("compressed")  # for panels that stay square
        grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for number, (title, rows) in enumerate(panels.items()):
            axes = grid.flat[number]
            cells = _draw_cells(axes, counts[title], edges, most)
            _draw_regions(axes, rows, limit_m)
            axes.set_title(caption(title))
            if number % columns == 0:
                axes.set_ylabel("protection level (m)")
            if number + columns >= len(panels):
                axes.set_xlabel("position error (m)")
                axes.tick_params(labelbottom=True)
        scale = figure.colorbar(cells, ax=grid, label="epochs", aspect=20 * lines)
        plain_numbers(scale.ax.yaxis)


def _draw_cells(axes: Any, counts: Index, edges: Array, most: int) -> Any:
    """A panel with a color for each cell that has epochs."""
    from matplotlib.colors import LogNorm

    shown = np.ma.masked_equal(counts, 0)
    cells = axes.pcolormesh(
        edges, edges, shown, norm=LogNorm(1, max(most, 2)), cmap="viridis_r", rasterized=True
    )
    ends = edges[[0, -1]]
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        plain_numbers(axis)
    return cells


def _draw_regions(axes: Any, rows: Array, limit_m: float) -> None:
    """Lines between the regions, and how many epochs are in each."""
    from matplotlib.patheffects import withStroke

    outline = [withStroke(linewidth=2.5, foreground="white")]
    low, high = axes.get_xlim()
    axes.plot([low, high], [low, high], color="black", lw=1.0)
    axes.plot([low, high], [limit_m] * 2, color="black", lw=1.0, ls="--")
    axes.plot([limit_m] * 2, [low, limit_m], color="black", lw=1.0, ls="--")
    near = 1.12  # a bit off the lines, on logarithmic axes
    places = {
        Region.NOMINAL: (low * near, limit_m / near, "left", "top"),
        Region.MISLEADING: (limit_m / near, low * near, "right", "bottom"),
        Region.HAZARDOUS: (limit_m * near, low * near, "left", "bottom"),
        Region.UNAVAILABLE: (low * near, high / near, "left", "top"),
        Region.UNAVAILABLE_MISLEADING: (high / near, limit_m * near, "right", "bottom"),
    }
    total = max(1, len(rows))
    for region, count in regions(rows[:, 0], rows[:, 1], limit_m).items():
        x, y, ha, va = places[region]
        words = region.value.replace(" and ", ",\n").replace("sly ", "sly\n")
        text = f"{words}\n{percent(count / total)}"
        axes.text(x, y, text, ha=ha, va=va, fontsize=7.5, path_effects=outline)
