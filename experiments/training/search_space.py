"""Search space of the best bank, and the bank at a point of the space."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from mmwave_env.filters.bank import Bank
from mmwave_env.filters.imm import DEFAULT_STAY
from mmwave_env.filters.modes import Mode
from mmwave_env.numerics.numbers import Array

SEED = 0  # seed of the search

Value = Callable[[Bank, int], float]

# Ranges to search:
ODDS = (-14.0, 8.0)  # log of a probability to change over that to stay
# Less velocity noise earns a little more where users walk as straight as simulated users do. A user
# who weaves a few degrees, as in the recording of a pedestrian, would escape such a filter.
FREE = {
    "sigma_p": (0.005, 2.0),
    "sigma_v": (0.04, 6.0),
    "acceleration_mps2": (0.3, 6.0),
    "turn_rate_radps": (0.02, 1.0),
}
NINES = (1.0, 9.0)  # nines of the quantile up to which NIS counts: 3 nines are 0.999
DECIMALS = 6  # digits of probabilities

_PROBABILITY_STEP, _NOISE_STEP, _NINES_STEP = 0.6, 0.25, 0.3  # deviations of the first points


def rows_as_softmax(odds: Array) -> Array:
    """Return transition probabilities (modes, modes), (from, to), as a softmax of free odds.

    Args:
        odds: (modes (modes - 1),) log of p_ij / p_ii, row by row without the diagonal.
    """
    modes = 1 + int(np.sqrt(len(odds)))
    logits = np.zeros((modes, modes))
    logits[~np.eye(modes, dtype=bool)] = odds
    transition: Array = softmax(logits, axis=1)
    return transition


class SearchSpace(NamedTuple):
    """Start, scale and bounds of a search for k numbers."""

    start: Array  # (k,) first center
    deviation: Array  # (k,) standard deviations of the first points
    bounds: Array  # (k, 2) lowest and highest values
    bank_at: Callable[[Array], Bank]  # bank at a point, with the digits of a file


def search_space(modes: Sequence[Mode]) -> SearchSpace:
    """Return the space of a bank's numbers: transition, noise, maneuvers and NIS quantile."""
    n = len(modes)
    change = np.log((1.0 - DEFAULT_STAY) / (n - 1) / DEFAULT_STAY)
    chances, limits = [change] * (n * (n - 1)), [ODDS] * (n * (n - 1))
    free = [(i, field) for i, field in product(range(n), FREE) if getattr(modes[i], field)]
    noise = [np.log(abs(getattr(modes[i], field))) for i, field in free]
    first = len(chances)

    def bank_at(point: Array) -> Bank:
        transition = rows_as_softmax(point[:first])
        found = list(modes)
        for (i, field), value in zip(free, np.exp(point[first:-1]), strict=True):
            found[i] = _with_size(found[i], field, value)
        return Bank(tuple(found), _written(transition), 1.0 - float(f"{10.0 ** -point[-1]:.2g}"))

    return SearchSpace(
        np.array([*chances, *noise, 3.0]),
        np.repeat([_PROBABILITY_STEP, _NOISE_STEP, _NINES_STEP], [first, len(free), 1]),
        np.array([*limits, *(np.log(FREE[field]) for _, field in free), NINES]),
        bank_at,
    )


def _with_size(mode: Mode, field: str, size: float) -> Mode:
    """Return the mode with a field of another size, to three digits, and the same sign."""
    value = float(np.copysign(float(f"{size:.3g}"), getattr(mode, field)))
    return replace(mode, **{field: value})  # type: ignore[arg-type]


def _written(transition: Array) -> tuple[tuple[float, ...], ...]:
    """Round probabilities to few digits so that rows still sum to 1."""
    short = transition.round(DECIMALS)
    np.fill_diagonal(short, 0.0)
    np.fill_diagonal(short, (1.0 - short.sum(axis=1)).round(DECIMALS))
    return tuple(map(tuple, short.tolist()))


def best_bank_of(space: SearchSpace, value: Value, evaluations: int) -> Bank:
    """Return the bank at the mean center of the second half of the search.

    Points are compared only within a generation, so each generation may have its own episodes. The
    center of the search then wanders about the optimum of all episodes, and the mean center comes
    closer to the optimum than the last center (Polyak and Juditsky 1992).

    Args:
        space: space to search.
        value: objective to maximize, of a bank and the number of the generation.
        evaluations: most calls of ``value``; fewer than a generation return the start.
    """
    from cmaes import CMA  # needs the extra "tune"

    first = np.diag(np.square(space.deviation))
    optimizer = CMA(space.start, 1.0, bounds=space.bounds, seed=SEED, cov=first)
    centers = [space.start]
    for generation in range(evaluations // optimizer.population_size):
        points = [optimizer.ask() for _ in range(optimizer.population_size)]
        optimizer.tell([(point, -value(space.bank_at(point), generation)) for point in points])
        centers.append(optimizer.mean.copy())
    return space.bank_at(np.mean(centers[len(centers) // 2 :], axis=0))
