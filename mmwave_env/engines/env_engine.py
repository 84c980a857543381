"""Environments in step, one or many at once."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import NO_ROWS, Program, rows_of
from mmwave_env.engines import per_mode_epoch, shared_epoch
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.track_engine import untuned
from mmwave_env.episodes.episode import Episode, EpisodeBatch
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.numerics.pytree import flatten
from mmwave_env.observation import Observation
from mmwave_env.reward import Reward


class Engine:
    """N environments in step: episodes in, actions in, observations and scores out.

    Args:
        pipeline: modes and layout.
        n: number of environments.
        reward: function of (belief, truth).
        observation: "full" or "prior".
        bank: of the pipeline's modes, where every mode keeps its own belief; None where they
            share one.
        on_floats: run in plain Python instead of on lanes (the filterpy twin needs it).
        threads: how many may work at once; results do not depend on it.

    Attributes:
        batch: their workspaces and episodes.
        at, read, column, span: the batch's.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        n: int,
        reward: Reward,
        observation: str = "full",
        bank: Bank | None = None,
        on_floats: bool = False,
        threads: int = 1,
    ) -> None:
        self.pipeline = pipeline
        self.observation = Observation(pipeline, observation, "per-mode" if bank else "shared")
        program: Program[Any] = (
            per_mode_epoch.program_of(untuned(pipeline), observation, reward)
            if bank
            else shared_epoch.program_of(pipeline, observation, reward)
        )
        action = np.array([program.index.action])
        self.batch = Batch(program, pipeline.layout, n, action, on_floats, threads)
        self.at = self.batch.at
        self.read, self.column, self.span = self.batch.read, self.batch.column, self.batch.span
        self._obs_rows = rows_of(self.at.observation)
        if bank:
            self.tune(bank)

    def tune(self, bank: Bank, places: Index | None = None) -> None:
        """Take another bank of such modes, in some environments (n,) or in all."""
        numbers = flatten(settings_of(bank, self.pipeline.layout))
        self.batch.write(self.at.settings, np.array(numbers), places)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Start over with one episode each and consider its first epoch."""
        self.batch.load(episodes)
        self.batch.advance()

    def load(self, episodes: EpisodeBatch | Sequence[Episode], places: Index) -> None:
        """Give some environments an episode, to start over with at the next run."""
        self.batch.load(episodes, places)

    def start(
        self, places: Index, output_rows: Index = NO_ROWS
    ) -> tuple[NDArray[np.float32], Array]:
        """Consider the first epoch in environments just loaded; the others stay as they are.

        Returns:
            As :meth:`step`, but sound only for these environments.
        """
        running = np.zeros(self.batch.n, np.bool_)
        running[places] = True
        io = self.batch.io(output_rows=output_rows, obs_rows=self._obs_rows)
        self.batch.advance(io, running)
        return io.observations[:, 0], io.outputs[:, 0]

    def step(
        self, actions: NDArray[np.integer[Any]] | np.int64, output_rows: Index = NO_ROWS
    ) -> tuple[NDArray[np.float32], Array]:
        """Take every environment's action (n,), or one for all, and consider the next epoch.

        An environment just loaded starts its episode instead.

        Args:
            actions: numbers of the modes; from 1 where each keeps its belief, and 0 for none.
            output_rows: (k,) numbers of rows to return, of :func:`rows_of` parts of ``at``.

        Returns:
            The observations (n, features), and what to tell (n, k); fresh arrays.
        """
        io = self.batch.io(output_rows=output_rows, obs_rows=self._obs_rows)
        io.inputs[:, 0, 0] = actions
        self.batch.advance(io)
        return io.observations[:, 0], io.outputs[:, 0]

    def observations(self) -> NDArray[np.float32]:
        """The current observations (n, features), a copy."""
        return self.read(self.at.observation, np.float32)
