"""Contenders' position errors, epoch by epoch, and statistics of errors and protection levels."""

from dataclasses import dataclass, field

import numpy as np

from experiments.console.output import grid
from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import EpochResults
from mmwave_env.io.files import Json
from mmwave_env.localization.levels import Levels
from mmwave_env.localization.position_errors import DISTANCES_M, SHARES, PositionErrors
from mmwave_env.metrics import scored
from mmwave_env.numerics.numbers import Array

KINDS = ("horizontal", "vertical")
HEADER = (
    *(f"{100.0 * share:.0f} % m" for share in SHARES),
    *(f"within {limit:g} m" for limit in DISTANCES_M),
    "level m",
    "above level",
)


@dataclass
class Positions:
    """Position errors of all scored epochs, with protection levels."""

    levels: Levels
    anchors: int  # number of anchors in the episodes
    planar: bool  # whether the height is known
    errors: dict[str, PositionErrors] = field(default_factory=dict)  # by contender

    def add(self, contender: Contender, time_s: Array, results: EpochResults) -> None:
        """Add a contender's epoch results on some episodes.

        The results must include :data:`~mmwave_env.localization.levels.PARTS`.
        """
        counts = scored(len(time_s))
        empty = PositionErrors(self.levels.risk, self.planar)
        errors = self.errors.setdefault(contender.name, empty)
        self.levels.reset()
        factors = self.levels.factors(self.anchors, contender.bank is not None, time_s, results)
        errors.add(results["error"][:, counts], results["P"][:, counts], factors[:, counts])

    def figures(self) -> Json:
        """Return errors and levels in the form that results files store."""
        policies = {name: errors.figures() for name, errors in self.errors.items()}
        return {"risk": self.levels.risk, "levels": self.levels.kind, "policies": policies}


@dataclass
class EpochErrors:
    """Errors and NEES of contenders in all scored epochs of equally long episodes."""

    time_s: Array = field(init=False)  # (T,) s since the first epoch
    errors_m: dict[str, Array] = field(default_factory=dict)  # contender -> (n, T, 3), m
    nees: dict[str, Array] = field(default_factory=dict)  # contender -> (n, T)

    def add(self, contender: Contender, time_s: Array, results: EpochResults) -> None:
        """Add a contender's epoch results on episodes whose epochs have these times (T,)."""
        counted = scored(len(time_s))
        self.time_s = (time_s - time_s[0])[counted]
        _append(self.errors_m, contender.name, results["error"][:, counted].astype(np.float32))
        _append(self.nees, contender.name, results["nees"][:, counted])


def _append(table: dict[str, Array], name: str, values: Array) -> None:
    table[name] = np.concatenate([table[name], values]) if name in table else values


def positions_markdown(title: str, rows: Json, risk: float, kind: str) -> str:
    """Return a table of errors and protection levels, with a note on the columns.

    The first column has the header ``title``. ``rows`` maps the names in this column to figures,
    among them those of :class:`~mmwave_env.localization.position_errors.PositionErrors`. ``risk``
    is the probability that an error exceeds its level. ``kind`` is "calibrated" or "gaussian".
    """
    cells = [
        [
            f"{name}, {axis}",
            *map(meters, errors["percentiles_m"].values()),
            *map(percent, errors["within_m"].values()),
            meters(errors["median_level_m"]),
            exceeded(errors),
        ]
        for name, axes in rows.items()
        for axis, errors in axes.items()
        if axis in KINDS
    ]
    return (
        f'{grid([title, *HEADER], cells)}\n\n"50 % m" is the error in m that 50 % of the epochs '
        'stay below, and so on; "within 1 m" is the share of epochs with an error of at most 1 m. '
        f"Level is the median {kind} protection level; at a risk of {risk:g}, errors should exceed "
        f"their levels in {percent(risk)} of the epochs.\n"
    )


def exceeded(figures: Json) -> str:
    """Return the share of epochs whose error exceeds its level, with a 95 % interval."""
    if figures["share"] is None:
        return "-"
    ends = ", ".join(percent(end).removesuffix(" %") for end in figures["ci95"])
    return f"{percent(figures['share'])} [{ends}]"


def meters(value: float | None) -> str:
    """Format a distance with three digits, or a large distance in whole meters."""
    if value is None:
        return "-"
    return f"{value:#.3g}" if value < 99.95 else f"{value:.0f}"


def percent(share: float | None) -> str:
    """Format a share as a percentage, with more decimals if it is close to 0 or 1."""
    if share is None:
        return "-"
    rest = 100.0 * min(share, 1.0 - share)
    digits = 1 if rest >= 1.0 or rest < 5e-5 else min(4, 1 - int(np.floor(np.log10(rest))))
    return f"{100.0 * share:.{digits}f} %"
