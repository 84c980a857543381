"""Contenders relative to the posterior Cramer-Rao bound of the same episodes.

Every kind of user (``Episode.name``) has the bound of its own motion, with the white-noise
acceleration of its true velocities; mean squares are pooled over kinds, episodes and the
epochs that count. See :mod:`experiments.evaluation.cramer_rao` for what such a bound means.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from experiments.console.tables import grid
from experiments.console.text import escaped
from experiments.evaluation.cramer_rao import (
    averaged_bound,
    conditional_bounds,
    measured_motion,
    position_variance,
)
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.runner import CHUNK, Scores
from experiments.evaluation.seeds import Selection
from mmwave_env.metrics import scored
from mmwave_env.models.radio import Radio
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode, EpisodeSource

COLUMNS = {  # headers of tables
    "rmse_m": "RMSE m",
    "over_averaged": "over averaged bound",
    "over_conditional": "over conditional bound",
}


@dataclass(frozen=True)
class Bounds:
    """Cramer-Rao bounds on the position error of a set of episodes."""

    averaged_m: float  # root mean square of the averaged bounds, m
    conditional_m: float  # root mean square of the bounds given each track, m
    # per kind of user, horizontal and vertical white-noise acceleration that the bounds assume,
    # (m/s) / sqrt(s)
    sigma_v: dict[str, dict[str, float]]


def bounds_of(episodes: Sequence[Episode], drift_mps: float) -> Bounds:
    """Compute bounds of episodes whose oscillators drift by ``drift_mps``, (m/s) / sqrt(s)."""
    kinds: dict[str, list[Episode]] = {}
    for episode in episodes:
        kinds.setdefault(episode.name, []).append(episode)
    averaged = conditional = 0.0
    sigma_v = {}
    for name, group in kinds.items():
        motion = measured_motion(group, drift_mps)
        horizontal, _, vertical = map(float, np.sqrt(motion.velocity))
        sigma_v[name] = {"horizontal": horizontal, "vertical": vertical}
        averaged += len(group) * _mean_square(averaged_bound(group, motion))
        for first in range(0, len(group), CHUNK):
            part = conditional_bounds(group[first : first + CHUNK], motion)
            conditional += len(part) * _mean_square(part)
    n = len(episodes)
    return Bounds(float(np.sqrt(averaged / n)), float(np.sqrt(conditional / n)), sigma_v)


def _mean_square(bound: Array) -> float:
    """Average the variance of the position over scored epochs of bounds (..., T, 7, 7), m^2."""
    return float(position_variance(bound)[..., scored(bound.shape[-3])].mean())


@dataclass(frozen=True)
class OverBound:
    """RMSE of contenders in units of the bounds."""

    bounds: Bounds  # bounds of the episodes
    # per contender its pooled RMSE ("rmse_m") and its ratio to each bound ("over_averaged",
    # "over_conditional"); intervals are over episodes, with the bounds held fixed
    policies: dict[str, dict[str, Interval]]

    @property
    def json(self) -> dict[str, Any]:
        """Return bounds and ratios as results files hold them."""
        rows = {n: {k: i.json for k, i in row.items()} for n, row in self.policies.items()}
        return asdict(self.bounds) | {"policies": rows}


def over_bound(
    scores: Mapping[str, Scores], source: EpisodeSource, radio: Radio, selection: Selection
) -> OverBound:
    """Compare contenders with the bounds of the episodes that their scores are from.

    Args:
        scores: metrics of the episodes, by contender.
        source, radio, selection: episodes that the scores are from.
    """
    squared = np.stack([np.square(s["rmse_m"]) for s in scores.values()], axis=1)
    # The episodes are drawn again rather than kept while all contenders run.
    bounds = bounds_of(selection.draw(source), radio.drift_mps)
    factors = (1.0, 1.0 / bounds.averaged_m, 1.0 / bounds.conditional_m)
    policies = {}
    for name, interval in zip(scores, bootstrap(squared), strict=True):
        roots = np.sqrt([interval.mean, interval.low, interval.high])
        rows = np.outer(factors, roots).tolist()
        policies[name] = {k: Interval(*row) for k, row in zip(COLUMNS, rows, strict=True)}
    return OverBound(bounds, policies)


def bound_markdown(over: OverBound) -> str:
    """Return ratios to the bounds as a Markdown table, with a note on the bounds."""
    b = over.bounds
    motion = "; ".join(
        f"{escaped(kind)} {sigma['horizontal']:.3g}, vertical {sigma['vertical']:.3g}"
        for kind, sigma in b.sigma_v.items()
    )
    about = (
        f"Over the posterior Cramer-Rao bound ({b.averaged_m:.3f} m averaged over tracks, "
        f"{b.conditional_m:.3f} m given each track) of a Gaussian model whose velocity increments "
        f"have the variance of the true ones (sigma_v {motion}): not strict for real maneuvers, "
        "and without the biases of blockage and multipath. Pooled over episodes, 95 % intervals:"
    )
    header = ["policy", *COLUMNS.values()]
    rows = [[name, *row.values()] for name, row in over.policies.items()]
    return f"\n{about}\n\n{grid(header, rows)}\n"
