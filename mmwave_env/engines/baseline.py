"""The baseline of ``reward="paired"``: the rewards of an IMM on the current episodes.

No action changes an episode, so the rewards of the IMM are known once the episode is loaded.
"""

from collections.abc import Callable
from dataclasses import replace
from math import fsum
from typing import Any

import numpy as np

from mmwave_env.compiler.threads import portions, share
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.imm_engine import ImmEngine
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.task import Task
from mmwave_env.world.episode import EpisodeBatch

TOGETHER = 256  # episodes at once: few enough for their memory not to matter


class Baseline:
    """Rewards of an IMM on the episodes of a batch.

    Args:
        task: the task, whose baseline is the IMM.
        batch: the batch that runs the episodes.
        threads: number of threads that may work at once; results do not depend on it.
    """

    def __init__(self, task: Task, batch: Batch[Any], threads: int = 1) -> None:
        bank = task.baseline
        assert bank is not None
        pipeline = replace(task.pipeline, modes=bank.modes)
        self._imm = ImmEngine(pipeline, task.reward, bank.transition, bank.nis_quantile)
        self._batch, self._threads = batch, threads
        self._rewards = np.zeros((batch.n, 0), np.float32)

    def begin(self, places: Index, episodes: Callable[[Index], EpisodeBatch]) -> None:
        """Run the IMM on the episodes that begin in some environments (n,).

        Args:
            places: the environments.
            episodes: function that returns the episodes of some of the environments.
        """
        missing = self._batch.state.length.max() - self._rewards.shape[1]
        self._rewards = np.pad(self._rewards, ((0, 0), (0, max(0, missing))))

        def run(some: Index) -> None:
            rewards = self._imm.run(episodes(some), "reward")["reward"]
            self._rewards[some, : rewards.shape[1]] = rewards

        parts = portions(len(places), self._threads, TOGETHER)
        share(run, [(places[part],) for part in parts], self._threads)

    def subtract(self, rewards: Array, places: Index) -> None:
        """Subtract from rewards (N,) the IMM's rewards in the epoch that was just processed.

        The result has single precision, which agents learn from, so recorded trainings repeat.

        Args:
            rewards: (N,) rewards of all environments, changed in place.
            places: (n,) environments that processed an epoch.
        """
        epoch = self._batch.state.epoch[places] - 2  # the epoch before the one considered
        rewards[places] = rewards[places].astype(np.float32) - self._rewards[places, epoch]

    def rest(self, places: Index) -> Array:
        """Return the IMM's total reward in the remaining epochs of some environments (n,)."""
        tracks = self._batch.state
        spans = zip(places, tracks.epoch[places] - 1, tracks.length[places], strict=True)
        return np.array([fsum(self._rewards[place, now:end]) for place, now, end in spans])
