"""Environments in step, one or many at once."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import NO_ROWS, BatchState, Program, StepIO, rows_of
from mmwave_env.engines import per_mode_epoch, shared_epoch
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.track_engine import untuned
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.numerics.pytree import flatten
from mmwave_env.observation import Observation
from mmwave_env.reward import Reward
from mmwave_env.task import Task
from mmwave_env.world.episode import Episode, EpisodeBatch, columns_of
from mmwave_env.world.keys import Keys


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
        keys: (n,) of the episodes, where they have some.
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
        action, self._on_floats = np.array([program.index.action]), on_floats
        self.keys = np.zeros(n, np.uint64)
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

    def reset(self, episodes: EpisodeBatch | Sequence[Episode]) -> None:
        """Start over with one episode each and consider its first epoch."""
        self.batch.load(episodes)
        self.batch.advance()

    def begin(self, task: Task, keys: Keys, places: Index, threads: int = 1) -> list[str]:
        """Begin the episodes of keys (n,) in some environments (n,).

        They are simulated as the environments go, unless the way of the user is given or floats
        are to run: then they are drawn at once.

        Args:
            task: with simulated episodes, the same always.
            keys: of the episodes.
            places: the environments.
            threads: how many may draw at once.

        Returns:
            The names (n,) of the episodes.
        """
        self.keys[places] = keys
        source = task.simulated
        if self._on_floats or not source.travels:
            episodes = task.tables(keys, threads)
            self.batch.load(episodes, places)
            return episodes.names
        begun = source.begin(keys)
        if self.pipeline.planar:
            begun = begun.on_flat_ground(source.layout)
        self.batch.begin(source, begun, places)
        return [source.names[kind] for kind in begun.kinds]

    def attach(self, task: Task) -> None:
        """Make room for the episodes of a task with simulated ones; those under way go on."""
        if task.simulated.travels:
            self.batch.attach(task.simulated)
        else:
            self.batch.make_room(task.simulated.epochs)

    def go_on(self, task: Task, tracks: BatchState) -> None:
        """Go on from the state that a batch of such a task was in, in this process or another."""
        if len(tracks.feed.kept):  # where compiled code lies is this process's own
            feed = tracks.feed._replace(run=task.simulated.world.on_lanes())
            tracks = tracks._replace(feed=feed)
        self.batch.state = tracks

    def episodes(self, task: Task, places: Index) -> EpisodeBatch:
        """The episodes under way in some environments (n,), whole."""
        if self.batch.state.feed.run:
            return task.tables(self.keys[places])
        return self.batch.episodes(places)

    def steps_s(self, places: Index) -> Array:
        """Seconds between epochs (n,) of the episodes under way, the median of each."""
        state, dt = self.batch.state, columns_of(self.batch.layout).dt
        if state.feed.run:
            return np.full(len(places), state.feed.times[1:2].sum() or 1.0)
        each = [state.table[place, 1 : state.length[place], dt] for place in places]
        return np.array([np.median(steps) if len(steps) else 1.0 for steps in each])

    def start(
        self, places: Index, output_rows: Index = NO_ROWS
    ) -> tuple[NDArray[np.float32], Array]:
        """Consider the first epoch in environments just loaded; the others stay as they are.

        Returns:
            As :meth:`step`, but sound only for these environments.
        """
        running = np.zeros(self.batch.n, np.bool_)
        running[places] = True
        io = self.io(output_rows)
        self.batch.advance(io, running)
        return io.observations[:, 0], io.outputs[:, 0]

    def io(self, output_rows: Index = NO_ROWS) -> StepIO:
        """Room for actions, observations and rows to tell, for a step."""
        return self.batch.io(output_rows=output_rows, obs_rows=self._obs_rows)

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
        io = self.io(output_rows)
        io.inputs[:, 0, 0] = actions
        self.batch.advance(io)
        return io.observations[:, 0], io.outputs[:, 0]

    def observations(self) -> NDArray[np.float32]:
        """The current observations (n, features), a copy."""
        return self.read(self.at.observation, np.float32)
