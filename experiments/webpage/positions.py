"""Tables and a picture of position errors and protection levels."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from experiments.evaluation.positions import HEADER, KINDS, percent, row_of
from experiments.figures.stanford import counts_of, edges_of
from experiments.webpage.charts import Chart
from experiments.webpage.markup import Cell, table
from mmwave_env.localization.position_errors import PositionErrors
from mmwave_env.localization.protection import ALERT_LIMIT_M, regions
from mmwave_env.lookup import printable
from mmwave_env.numerics.arrays import Array


def position_table(what: str, rows: Mapping[str, Mapping[str, Any]], risk: float) -> str:
    """Percentiles, shares and protection levels, a row for each kind of error.

    Args:
        what: the rows are of.
        rows: figures of :class:`~mmwave_env.localization.position_errors.PositionErrors` by name.
        risk: of the levels.
    """
    caption = (
        "Errors that so many percent of the epochs stay below, shares of the epochs within a "
        "distance, the median protection level, and the share of the epochs with an error above "
        f"theirs, which a risk of {risk:g} allows in {percent(risk)}"
    )
    cells: list[list[str | Cell]] = [
        [f"{name}, {kind}", *_cells(one)]
        for name, kinds in rows.items() for kind, one in kinds.items()
    ]  # fmt: skip
    return table(caption, [what, *HEADER], cells)


def _cells(figures: Mapping[str, Any]) -> Iterator[Cell]:
    values = [
        *figures["percentiles_m"].values(), *figures["within_m"].values(),
        figures["median_level_m"], figures["share"],
    ]  # fmt: skip
    for shown, value in zip(row_of(figures), values, strict=True):
        yield Cell(shown, value)


def stanford(errors: Mapping[str, PositionErrors], limit_m: float = ALERT_LIMIT_M) -> Chart:
    """Errors against protection levels, a view for each contender and kind."""
    rows = {
        f"{kind}, {printable(name)}": one.kinds[kind].rows()
        for kind in KINDS for name, one in errors.items() if kind in one.kinds
    }  # fmt: skip
    edges = edges_of(rows.values(), limit_m)
    views = [_view(name, one, edges, limit_m) for name, one in rows.items()]
    return {"kind": "stanford", "title": "Errors and protection levels", "views": views}


def _view(name: str, rows: Array, edges: Array, limit_m: float) -> dict[str, Any]:
    counts = counts_of(rows, edges)
    level, error = np.nonzero(counts)
    found = regions(rows[:, 0], rows[:, 1], limit_m)
    return {
        "name": name,
        "ends": [float(f"{end:.4g}") for end in edges[[0, -1]]],
        "side": len(edges) - 1,
        "cells": np.stack([error, level, counts[level, error]], axis=1).tolist(),
        "limit": limit_m,
        "regions": {one.value: percent(n / max(1, len(rows))) for one, n in found.items()},
    }
