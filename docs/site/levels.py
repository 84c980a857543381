"""Tables of protection levels at all sites of the benchmark; docs/errors.md shows one table.

``PYTHONPATH=. python docs/site/levels.py`` plays test episodes for about two minutes.
"""

import warnings

import numpy as np
from numpy.typing import NDArray

from experiments.console.tables import grid
from experiments.evaluation.contenders import Contender
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.protocol import HARD, RECORDED, Site, sites
from experiments.evaluation.runner import EpochResults, score_contenders
from experiments.evaluation.seeds import Selection
from mmwave_env.localization.levels import PARTS, Levels
from mmwave_env.localization.position_errors import gaussian_levels, horizontal, vertical
from mmwave_env.metrics import scored
from mmwave_env.numerics.numbers import Array

POLICIES = ("guided", "corrector")
# test episodes at a site; fewer at recorded or hard sites
EPISODES = 400
FEWER = 60
DIRECTIONS = ("Horizontally", "Vertically")
RISKS = (1e-3, 1e-2)


def cells_at(site: Site) -> NDArray[np.str_]:
    """Return the cells (risks, directions, 6) of a site's rows in the tables.

    Each of the two policies has three cells: the shares of epochs (%) in which errors exceed the
    Gaussian and the calibrated level, and the ratio of the calibrated to the Gaussian level.
    """
    cells: list[list[list[list[str]]]] = [[[], []] for _ in RISKS]
    source = site.source()
    few = site.kind in (RECORDED, HARD)

    def add(contender: Contender, time_s: Array, results: EpochResults) -> None:
        parts = [*(results[p] for p in PARTS), results.get("trusted")]
        counts = scored(len(time_s))
        error = np.stack([f(results["error"]) for f in (horizontal, vertical)], axis=-1)
        for rows, risk in zip(cells, RISKS, strict=True):
            gaussian = gaussian_levels(results["P"], risk)
            factors = Levels(risk).factors(source.layout.anchors, contender.mixes, time_s, *parts)
            both = np.stack([gaussian, gaussian * factors])[:, :, counts]
            over = 100.0 * ~(error[:, counts] <= both)
            width = np.median(both[1], axis=(0, 1)) / np.median(both[0], axis=(0, 1))
            for i, row in enumerate(rows):
                promised, share = bootstrap(over.mean(axis=2)[..., i].T)
                calibrated = f"{share.mean:.2f} (≤ {share.high:.2f})"
                row.append([f"{promised.mean:.2f}", calibrated, f"{width[i]:.2f}"])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # modes are untuned for an unseen radio on purpose
        seeds = Selection(range(FEWER if few else EPISODES))
        score_contenders(POLICIES, source, site.radio, seeds, watch=[add], after=PARTS)
    return np.reshape(cells, (len(RISKS), len(DIRECTIONS), -1))


if __name__ == "__main__":
    cells = np.stack([cells_at(site) for site in sites()], axis=2)
    names = [site.name for site in sites()]
    columns = ("Gaussian", "calibrated", "×")
    header = ["site", *(f"{name}: {column}" for name in POLICIES for column in columns)]
    for risk, directions in zip(RISKS, cells, strict=True):
        for direction, rows in zip(DIRECTIONS, directions, strict=True):
            lines = [[name, *row] for name, row in zip(names, rows, strict=True)]
            print(f"{direction}, at a risk of {risk:g}:\n\n{grid(header, lines)}\n")
