"""Tuning of the bank of imm-best: modes that stand, cruise, turn, accelerate and brake.

All numbers of the bank are tuned at once, for the mean reward on all shipped streets at two rates.
"""

from collections.abc import Sequence
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from experiments.console.options import WorldArgs
from experiments.console.progress import progress
from experiments.evaluation.asked import source_of
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.seeds import draw_episodes
from experiments.training.search_space import best_bank_of, search_space
from mmwave_env.engines.imm_engine import ImmEngine
from mmwave_env.filters.bank import Bank, bank_as_written, default_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.io.lookup import require_extra
from mmwave_env.metrics import DIVERGENCE_M, scored
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import EpisodeBatch, EpisodeSource

STEPS_S = (1.0, 0.1)  # steps between epochs
SHARES = 3  # parts of the tuning episodes; a generation of the search uses one part
# Modes of steady motion, whose gates reject contradicting measurements as outliers. The other modes
# inflate the noise of such a measurement instead, since it may show a maneuver.
_STEADY = {"stand": ("ekf", 0.05), "cruise": ("ukf", 0.5)}
# algorithm, velocity noise, known acceleration
_LIVELY = {"turn": ("ukf", 1.9, 0.0), "accelerate": ("ukf", 0.3, 2.0), "brake": ("ukf", 0.2, -2.0)}


def _mode(
    name: str, algorithm: str, sigma_v: float, acceleration_mps2: float = 0.0, robust: bool = False
) -> Mode:
    return Mode(
        name, algorithm, sigma_p=0.01, sigma_v=sigma_v, acceleration_mps2=acceleration_mps2,
        adaptive=False, blockage_aware=True, robust=robust,
    )  # fmt: skip


START = (
    *(_mode(name, *numbers) for name, numbers in _STEADY.items()),
    *(_mode(name, *numbers, robust=True) for name, numbers in _LIVELY.items()),
)


def tuned_bank(
    radio: str, episodes: int, seed: int, evaluations: int, start: Sequence[Mode] = START
) -> dict[str, Any]:
    """Return the best bank of a radio that the search finds on tuning episodes, as in files.

    Args:
        radio: radio profile, a name or a JSON file.
        episodes: number of episodes to tune on, in equal shares of streets and rates; as many
            episodes of the following seeds measure the result.
        seed: seed of the first episode.
        evaluations: most evaluations of the search.
        start: modes before tuning.

    Raises:
        ValueError: too few episodes.
        ModuleNotFoundError: the extra "tune" is not installed.
    """
    require_extra("cmaes", "tune", "tune --bank")
    sources = [
        source_of(WorldArgs(radio=radio, scene=scene, dt=dt)) for scene in SCENES for dt in STEPS_S
    ]
    each = episodes // len(sources)
    shares = drawn(sources, range(seed, seed + each), SHARES)
    (held_out,) = drawn(sources, range(seed + each, seed + 2 * each))
    space = search_space(start)

    def value(bank: Bank, generation: int) -> float:
        return float(scores(bank, shares[generation % SHARES]).reward.mean())

    began = process_time()
    with progress("bank"):
        bank = best_bank_of(space, value, evaluations)
    seconds = round(process_time() - began)
    found = scores(bank, held_out)
    imm = scores(Bank(default_modes(radio_from(radio).base)), held_out)
    columns = {"reward": found.reward, "minus imm": found.reward - imm.reward, "lost": found.lost}
    figures: Sequence[Interval] = bootstrap(np.stack([*columns.values()], axis=1))
    return bank_as_written(bank) | {
        "numbers": len(space.start),
        "seconds": seconds,
        "held_out": {name: one.json for name, one in zip(columns, figures, strict=True)},
    }


class Scores(NamedTuple):
    """Rewards of a bank, and tracks that it lost, per episode."""

    reward: Array  # (n,) mean over the scored epochs
    lost: Array  # (n,) 1 where the track ends farther than DIVERGENCE_M from the truth, else 0


def drawn(
    sources: Sequence[EpisodeSource], seeds: range, shares: int = 1
) -> list[list[EpisodeBatch]]:
    """Draw episodes in equal parts; each part has a batch for each source, in order.

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
    """Run the IMM of a bank on all episodes, batch after batch."""
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
