"""Continuous trust found by an evolution strategy, in place of a policy gradient.

The logarithm of the factor on the probability of each mode is linear in a few features. Its weights
start at zero, where the agent is the IMM, and follow CMA-ES (Hansen 2016, arXiv 1604.00772): all
points of a generation meet the same training episodes, other ones in each generation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.seeds import TRAINING_SEED, TUNING_SEED, keys_of
from experiments.learning.continuous_trust import TrustEngine
from mmwave_env.episodes.episode import EpisodeBatch
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.filters.bank import Bank, bank_as_written, bank_in
from mmwave_env.numerics.arrays import Array
from mmwave_env.observation import Observation
from mmwave_env.task import task_from

FEATURES = (
    "predicted speed", "coming Doppler innovation", "Doppler spread fast average",
    "Doppler spread slow average", "Doppler spread slowest average", "NIS fast average",
    "correction along",
)  # fmt: skip
OF_MODES = ("coming log-odds", "coming velocity correction along")  # features of each mode
EPISODES = 64  # of a generation
DEVIATION = 0.2  # of the first generation's weights
SEED = 0  # of the points that are drawn
LOOKS = 10  # at the center of the search, on tuning episodes
TUNING_EPISODES = 500


@dataclass(frozen=True)
class LinearTrust:
    """Trust that is linear in features, relative to that of the first mode.

    Attributes:
        bank: of the modes.
        weights: (points, features + 1, modes - 1) of standardized features, last of a constant;
            environments side by side are shared out among the points.
    """

    bank: Bank
    weights: Array

    @cached_property
    def features(self) -> list[str]:
        """Names of the features."""
        modes = [mode.name for mode in self.bank.modes]
        return [*FEATURES, *(f"{kind} {mode}" for mode in modes for kind in OF_MODES)]

    @cached_property
    def _columns(self) -> list[int]:
        """Which of an observation the features are; streets alike in their number of anchors."""
        task = task_from(beliefs="per-mode", modes=self.bank)
        names = [f.name for f in Observation(task.pipeline, beliefs="per-mode").features]
        return [names.index(name) for name in self.features]

    def __call__(self, observations: NDArray[np.float32]) -> Array:
        """Logarithms of factors (n, modes) for observations (n, features)."""
        n, points = len(observations), len(self.weights)
        seen = np.ones((n, len(self._columns) + 1))
        seen[:, :-1] = observations[:, self._columns]
        others = seen.reshape(points, n // points, -1) @ self.weights
        return np.hstack([np.zeros((n, 1)), others.reshape(n, -1)])

    @property
    def json(self) -> dict[str, Any]:
        """As a file holds it; :meth:`of` makes it of that."""
        return {
            "features": self.features, "weights": self.weights.tolist(),
            "bank": bank_as_written(self.bank),
        }  # fmt: skip

    @classmethod
    def of(cls, content: dict[str, Any]) -> "LinearTrust":
        """The one that a file holds."""
        return cls(bank_in(content["bank"]), np.array(content["weights"]))


def evolved(
    bank: Bank, source: SimulatedSource, generations: int, tell: Callable[[int, float], None]
) -> tuple[LinearTrust, dict[str, Any]]:
    """The best center of the search on tuning episodes.

    Args:
        bank: of the modes.
        source: of the episodes.
        generations: how many.
        tell: takes the number of generations so far and the gain over the IMM on tuning episodes.

    Returns:
        It, and figures of the search as a file holds them.
    """
    from cmaes import CMA  # of the extra "tune"

    began = process_time()
    best, best_gains = _none(bank), np.zeros(TUNING_EPISODES)
    shape = best.weights.shape[1:]
    optimizer = CMA(np.zeros(best.weights.size), DEVIATION, seed=SEED)
    population = optimizer.population_size
    engine = TrustEngine(bank, source.layout, population * EPISODES)
    tuning = TrustEngine(bank, source.layout, TUNING_EPISODES)
    tuning_episodes = _drawn(source, TUNING_SEED, TUNING_EPISODES)
    imm = tuning.run(tuning_episodes, best)
    looks = {round(generations * (look + 1) / LOOKS) for look in range(LOOKS)}
    for generation in range(1, generations + 1):
        points = [optimizer.ask() for _ in range(population)]
        trust = LinearTrust(bank, np.reshape(points, (population, *shape)))
        first = TRAINING_SEED + EPISODES * (generation - 1)
        rewards = engine.run(_copies(_drawn(source, first, EPISODES), population), trust)
        losses = -rewards.reshape(population, EPISODES).mean(axis=1)
        optimizer.tell(list(zip(points, losses.tolist(), strict=True)))
        if generation in looks:
            center = LinearTrust(bank, optimizer.mean.reshape(1, *shape).copy())
            gains = tuning.run(tuning_episodes, center) - imm
            tell(generation, float(gains.mean()))
            if gains.mean() > best_gains.mean():
                best, best_gains = center, gains
    (gain,) = bootstrap(best_gains[:, None])
    return best, {
        "generations": generations, "population": population, "episodes": EPISODES,
        "seconds": round(process_time() - began),
        "tuning": {
            "seed": TUNING_SEED, "episodes": TUNING_EPISODES, "minus its own IMM": gain.json,
        },
    }  # fmt: skip


def _none(bank: Bank) -> LinearTrust:
    """The start: no mode is trusted."""
    count = len(FEATURES) + len(bank.modes) * len(OF_MODES)
    return LinearTrust(bank, np.zeros((1, count + 1, len(bank.modes) - 1)))


def _drawn(source: SimulatedSource, seed: int, episodes: int) -> EpisodeBatch:
    """The episodes of seeds ``seed .. seed + episodes - 1``."""
    return source.sample_batch(keys_of(range(seed, seed + episodes)))


def _copies(episodes: EpisodeBatch, times: int) -> EpisodeBatch:
    """The episodes, again and again."""
    return episodes._replace(
        names=episodes.names * times,
        nonfinite=np.tile(episodes.nonfinite, times),
        length=np.tile(episodes.length, times),
        table=np.tile(episodes.table, (times, 1, 1)),
        site=np.tile(episodes.site, (times, 1)),
    )
