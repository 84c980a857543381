"""What a bank earns on the streets of several scenes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from experiments.evaluation.seeds import draw_episodes
from mmwave_env.engines.imm_engine import ImmEngine
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.metrics import DIVERGENCE_M, scored
from mmwave_env.numerics.arrays import Array
from mmwave_env.reward import TrackingReward
from mmwave_env.world.episode import EpisodeBatch, EpisodeSource


class Scores(NamedTuple):
    """What a bank earns, per episode."""

    reward: Array  # (n,) mean over the epochs that are scored
    lost: Array  # (n,) 1 where the track ends farther than DIVERGENCE_M from the truth, else 0


def drawn(
    sources: Sequence[EpisodeSource], seeds: range, shares: int = 1
) -> list[list[EpisodeBatch]]:
    """Episodes in shares that are alike: each has a batch for each of the sources, in their order.

    Raises:
        ValueError: fewer seeds than shares.
    """
    if len(seeds) < shares:
        raise ValueError(
            f"episodes: found {len(seeds)} for each scene and step, expected {shares} or more, "
            f"{shares * len(sources)} in all"
        )
    episodes = [draw_episodes(source, seeds) for source in sources]
    return [[EpisodeBatch.of(some[share::shares]) for some in episodes] for share in range(shares)]


def scores(bank: Bank, batches: Sequence[EpisodeBatch]) -> Scores:
    """Run the IMM over a bank on all episodes, batch after batch."""
    reward, lost = [], []
    for batch in batches:
        imm = ImmEngine(
            Pipeline(bank.modes, batch.layout), TrackingReward(), bank.transition, bank.nis_quantile
        )
        found = imm.run(batch, "reward", "error")
        counted = scored(found["reward"].shape[1])
        reward.append(found["reward"][:, counted].mean(axis=1))
        lost.append(np.linalg.norm(found["error"][:, -1], axis=1) > DIVERGENCE_M)
    return Scores(np.concatenate(reward), np.concatenate(lost).astype(float))
