"""The search for the best bank, by CMA-ES (Hansen 2016, arXiv 1604.00772)."""

from collections.abc import Callable

import numpy as np

from experiments.tuning.search_space import SearchSpace
from mmwave_env.filters.bank import Bank

SEED = 0  # of the points that are drawn

Value = Callable[[Bank, int], float]


def best_bank_of(space: SearchSpace, value: Value, evaluations: int) -> Bank:
    """The bank at the mean of the second half of the search.

    Points of a generation are compared among themselves alone, so each generation may be judged on
    episodes of its own. The center of the search then wanders about the optimum of all episodes, to
    which its mean comes closer than its last place (Polyak and Juditsky 1992).

    Args:
        space: where to search.
        value: what is to be large, of a bank and the number of the generation.
        evaluations: how often to ask for it, at most; fewer than a generation leave the start.
    """
    from cmaes import CMA  # of the extra "tune"

    first = np.diag(np.square(space.deviation))
    optimizer = CMA(space.start, 1.0, bounds=space.bounds, seed=SEED, cov=first)
    centers = [space.start]
    for generation in range(evaluations // optimizer.population_size):
        points = [optimizer.ask() for _ in range(optimizer.population_size)]
        optimizer.tell([(point, -value(space.bank_at(point), generation)) for point in points])
        centers.append(optimizer.mean.copy())
    return space.bank_at(np.mean(centers[len(centers) // 2 :], axis=0))
