"""Table of smoothed tracks at all sites of the benchmark, before and after `localize --two-way`.

``PYTHONPATH=. python docs/site/two_way.py`` plays test episodes for about five minutes.
"""

import warnings
from collections.abc import Sequence

import numpy as np

from experiments.console.output import grid
from experiments.evaluation.contenders import draw_episodes
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.protocol import HARD, RECORDED, Site, sites
from experiments.training.corrector_data import smoothed
from mmwave_env.filters.correction import corrected_all
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.metrics import scored
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import EpisodeBatch
from policies import LearnedSwitch
from policies.corrector import TWO_WAY, TwoWayCorrector

BASE = "guided"
# test episodes at a site; fewer on a recording or at a hard site
EPISODES = 200
FEWER = 20


def nees(error: Array, P: Sequence[Sequence[Array]]) -> Array:
    """Return the NEES (n, T) of position errors (n, T, 3), given covariances as arrays (n, T)."""
    covariance = np.stack([np.stack([P[i][j] for j in range(3)], -1) for i in range(3)], -2)
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray((error * solved).sum(axis=-1))


def row(site: Site, network: TwoWayCorrector) -> list[object]:
    """Return a row of the table: mean errors, their difference, and mean NEES."""
    bank = LearnedSwitch(BASE).bank(site.radio)
    few = site.kind in (RECORDED, HARD)
    seeds = range(FEWER if few else EPISODES)
    batch = EpisodeBatch.of(draw_episodes(site.source(), seeds))
    pipeline = Pipeline(bank.modes, batch.layout)
    track = smoothed(batch, bank, BASE)
    counts = scored(batch.table.shape[1])
    shift, log_factor, trusted = (p.astype(float) for p in network(pipeline, track.features))
    belief = corrected_all(track.x, track.P, shift, log_factor, pipeline)
    better = track.error + (np.stack(belief.x[:3], axis=-1) - track.x[..., :3])
    raw = unpack(list(np.moveaxis(track.P, -1, 0)))
    errors = [np.linalg.norm(e[:, counts], axis=-1).mean(axis=1) for e in (track.error, better)]
    before, after, less = bootstrap([*errors, errors[1] - errors[0]])
    ratios = (nees(*of)[:, counts].mean() for of in ((track.error, raw), (better, belief.P)))
    figures = [f"{before.mean:.3f}", f"{after.mean:.3f}", less]
    return [site.name, *figures, *(f"{r:.2f}" for r in ratios), f"{100 * trusted.mean():.0f} %"]


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # modes are untuned for an unseen radio on purpose
    header = ["site", "smoothed m", "two ways m", "difference", "NEES", "NEES, two ways", "trusted"]
    print(grid(header, [row(site, TwoWayCorrector(TWO_WAY)) for site in sites()]))
