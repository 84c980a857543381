"""Tables of protection levels at all sites of the benchmark; docs/errors.md shows one table.

``PYTHONPATH=. python docs/site/levels.py`` plays test episodes for about two minutes.
"""

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from experiments.console.output import grid
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.protocol import HARD, KINDS, RECORDED, Site, sites
from experiments.evaluation.runner import EpochResults, score_contenders
from mmwave_env.localization.levels import PARTS, Levels
from mmwave_env.localization.position_errors import error_sizes, gaussian_levels
from mmwave_env.metrics import scored
from mmwave_env.numerics.numbers import Array

POLICIES = ("guided", "corrector")
# test episodes at a site; fewer at recorded or hard sites
EPISODES = 400
FEWER = 60
DIRECTIONS = ("Horizontally", "Vertically")
RISKS = (1e-3, 1e-2)


def figures_at(site: Site) -> Array:
    """Return figures (risks, directions, 2, 4) of a site, for each of the two policies.

    They are the shares of epochs (%) in which errors exceed the Gaussian and the calibrated level,
    the upper end of the latter's interval, and the ratio of the calibrated to the Gaussian level.
    """
    figures: list[list[list[list[float]]]] = [[[], []] for _ in RISKS]
    source = site.source()
    few = site.kind in (RECORDED, HARD)

    def add(contender: Contender, time_s: Array, results: EpochResults) -> None:
        counts = scored(len(time_s))
        error = error_sizes(results["error"])
        for rows, risk in zip(figures, RISKS, strict=True):
            gaussian = gaussian_levels(results["P"], risk)
            factors = Levels(risk).factors(
                source.layout.anchors, bool(contender.bank), time_s, results
            )
            both = np.stack([gaussian, gaussian * factors])[:, :, counts]
            over = 100.0 * ~(error[:, counts] <= both)
            width = np.median(both[1], axis=(0, 1)) / np.median(both[0], axis=(0, 1))
            for i, row in enumerate(rows):
                promised, share = bootstrap(over.mean(axis=2)[..., i])
                row.append([promised.mean, share.mean, share.high, width[i]])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # modes are untuned for an unseen radio on purpose
        seeds = range(FEWER if few else EPISODES)
        contenders = [contender_from(name, site.radio) for name in POLICIES]
        score_contenders(contenders, source, seeds, watch=[add], after=PARTS)
    return np.array(figures)


def by_kind(kinds: NDArray[np.str_], figures: Array) -> str:
    """Return a table, from figures (sites, 2, 4): the worst site of each kind, and all ratios."""
    rows = []
    for kind in KINDS:
        row = [kind]
        for policy in figures[kinds == kind].swapaxes(0, 1):
            promised, _, high, width = policy.T
            span = f"{width.min():.2f} to {width.max():.2f}"
            row += [f"{promised.max():.2f}", f"{high.max():.2f}", span]
        rows.append(row)
    return grid(header("sites", "calibrated, at most"), rows)


def by_site(names: Sequence[str], figures: Array) -> str:
    """Return a table, from figures (sites, 2, 4), with a row for each site."""
    rows = []
    for name, of_site in zip(names, figures, strict=True):
        row = [name]
        for promised, share, high, width in of_site:
            row += [f"{promised:.2f}", f"{share:.2f} (≤ {high:.2f})", f"{width:.2f}"]
        rows.append(row)
    return grid(header("site", "calibrated"), rows)


def header(first: str, calibrated: str) -> list[str]:
    """Return the headers of a table."""
    return [first, *(f"{p}: {c}" for p in POLICIES for c in ("Gaussian", calibrated, "×"))]


if __name__ == "__main__":
    places = sites()
    kinds = np.array([site.kind for site in places])
    everything = np.stack([figures_at(site) for site in places], axis=2)
    for risk, directions in zip(RISKS, everything, strict=True):
        for direction, figures in zip(DIRECTIONS, directions, strict=True):
            print(f"{direction}, at a risk of {risk:g}:\n\n{by_kind(kinds, figures)}\n")
            print(f"{by_site([site.name for site in places], figures)}\n")
