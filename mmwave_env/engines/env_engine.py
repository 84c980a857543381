"""The engine of environments, which steps one or many environments together."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import NO_ROWS, BatchState, StepIO, rows_of
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.environment_epoch import program_of
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, MODE
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import Policy, policy_from
from mmwave_env.interface.reward import Reward
from mmwave_env.interface.signed import after_update
from mmwave_env.io.lookup import choose
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.numerics.pytree import flatten
from mmwave_env.task import Base, Task
from mmwave_env.world.episode import Episode, EpisodeBatch, columns_of
from mmwave_env.world.keys import Keys


class Engine:
    """N environments that step together, and that return observations and scores.

    Args:
        pipeline: modes and layout.
        n: number of environments.
        reward: function of (belief, truth).
        observation: kind of observation: "full", "prior" or "signed".
        bank: the pipeline's modes and their transition probabilities, if every mode keeps its own
            belief; None if the modes share a belief.
        action, base: same as in :class:`~mmwave_env.task.Task`.
        on_floats: whether to run in plain Python, as filterpy requires, instead of on SIMD lanes.
        threads: maximum number of threads in use; results do not depend on it.

    Attributes:
        batch: workspaces and episodes of the environments.
        keys: (n,) keys of the episodes; only :meth:`begin` sets them.
        at, read, column, span: same as in ``batch``.
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
        action: str = MODE,
        base: Base | None = None,
    ) -> None:
        self.pipeline = pipeline
        ahead = int(action == CORRECTION)
        if ahead:
            choose({"full": None}, observation, 'observation, with action="correction",')
            observation = "signed"
        table = Observation(pipeline, observation, "per-mode" if bank else "shared")
        self.observation = table
        self._shown = cast(Any, slice(None))
        if ahead:  # leave out the features that depend on the coming epoch
            self.observation = table.only(after_update(pipeline, per_mode=True))
            self._shown = [table.names.index(name) for name in self.observation.names]
        self._base = _base_from(base(table)) if base else None
        program = program_of(pipeline, observation, reward, bank is not None, action)
        inputs = rows_of([program.index.action, getattr(program.index, "numbers", [])])
        self._on_floats = on_floats
        self.keys = np.zeros(n, np.uint64)
        self.batch = Batch(program, pipeline.layout, n, inputs, on_floats, threads, ahead)
        self.at = self.batch.at
        self.read = self.batch.read
        self.column = self.batch.column
        self.span = self.batch.span
        self.obs_rows = rows_of(self.at.observation)[self._shown]
        if bank:
            self.tune(bank)

    def tune(self, bank: Bank, places: Index | None = None) -> None:
        """Load a bank into the environments with indices ``places`` (n,); None for all.

        The bank's modes may differ from the pipeline's modes only in their tuning.
        """
        numbers = flatten(settings_of(bank, self.pipeline.layout))
        self.batch.write(self.at.settings, np.array(numbers), places)

    def reset(self, episodes: EpisodeBatch | Sequence[Episode]) -> None:
        """Start over with one episode for each environment and run the modes on its first epoch."""
        self.batch.load(episodes)
        self.batch.advance()
        self.lead(np.arange(self.batch.n))

    def begin(self, task: Task, keys: Keys, places: Index, threads: int = 1) -> list[str]:
        """Begin the episodes with given keys (n,) in some environments (n,).

        Episodes are simulated while the environments step. If users follow given trajectories, or
        if the engine runs in plain Python, complete episodes are drawn here instead.

        Args:
            task: a task with simulated episodes, the same in every call.
            keys: (n,) 64-bit numbers, each of which determines an episode.
            places: (n,) indices of the environments.
            threads: maximum number of threads that draw episodes.

        Returns:
            The names (n,) of the episodes.
        """
        self.keys[places] = keys
        source = task.simulated
        if self._on_floats or not source.travels:
            episodes = task.tables(keys, threads)
            self.batch.load(episodes, places)
            return episodes.names
        starts = source.begin(keys)
        if self.pipeline.planar:
            starts = starts.on_flat_ground(source.layout)
        self.batch.begin(source, starts, places)
        return [source.names[kind] for kind in starts.kinds]

    def go_on(self, task: Task, tracks: BatchState) -> None:
        """Continue from a batch's state, which another process may have saved with this task."""
        if len(tracks.feed.kept):  # the address of compiled code differs between processes
            feed = tracks.feed._replace(run=task.simulated.world.on_lanes())
            tracks = tracks._replace(feed=feed)
        self.batch.state = tracks

    def episodes(self, task: Task, places: Index) -> EpisodeBatch:
        """Return the complete current episodes of some environments (n,)."""
        if self.batch.state.feed.run:
            return task.tables(self.keys[places])
        return self.batch.episodes(places)

    def steps_s(self, places: Index) -> Array:
        """Return the median time (n,) in seconds between the epochs of each current episode."""
        state = self.batch.state
        dt = columns_of(self.batch.layout).dt
        if state.feed.run:
            return np.full(len(places), state.feed.times[1:2].sum() or 1.0)
        each = [state.table[place, 1 : state.length[place], dt] for place in places]
        return np.array([np.median(steps) if len(steps) else 1.0 for steps in each])

    def start(
        self, places: Index, output_rows: Index = NO_ROWS
    ) -> tuple[NDArray[np.float32], Array]:
        """Run the modes on the next epoch in environments just loaded; leave the others unchanged.

        The results have the same shapes as in :meth:`step`, but are valid only for ``places``.
        """
        running = np.zeros(self.batch.n, np.bool_)
        running[places] = True
        io = self.io(output_rows)
        io.inputs[:, 0, 0] = self.choices()
        self.batch.advance(io, running)
        return io.observations[:, 0], io.outputs[:, 0]

    def lead(self, places: Index) -> None:
        """Run the next epoch at the beginning of episodes, if actions are corrections.

        The filters must have run epoch 1 before an action can correct the belief of epoch 0.
        """
        if self.batch.ahead:
            self.start(places)

    def choices(self) -> Index:
        """Return the current actions (n,) of the agent ``base``; zeros if ``base`` is None."""
        n = self.batch.n
        if self._base is None:
            return np.zeros(n, np.int64)
        actions: Index = np.asarray(self._base.act(self.read(self.at.observation, np.float32)))
        whole = actions.dtype.kind in "iu"
        count = len(self.observation.actions)
        if whole and actions.shape == (n,) and actions.min() >= 0 and actions.max() < count:
            return actions
        raise ValueError(f"actions of base: found {actions}, expected {n} integers in [0, {count})")

    def io(self, output_rows: Index = NO_ROWS) -> StepIO:
        """Return the buffers of a step: for actions, observations and output rows."""
        return self.batch.io(output_rows=output_rows, obs_rows=self.obs_rows)

    def step(
        self, actions: NDArray[np.integer[Any]] | np.int64, output_rows: Index = NO_ROWS
    ) -> tuple[NDArray[np.float32], Array]:
        """Apply actions (n,), or one action to all; run the modes on the next epoch.

        An environment that was just loaded ignores its action and starts its episode.

        Args:
            actions: numbers of modes, counted from 0; if every mode has its own belief, modes are
                counted from 1, and action 0 leaves all probabilities as they are.
            output_rows: (k,) indices of the rows to return, for example from :func:`rows_of`.

        Returns:
            The observations (n, features) and the output rows (n, k), in new arrays.
        """
        io = self.io(output_rows)
        io.inputs[:, 0, 0] = actions
        self.batch.advance(io)
        return io.observations[:, 0], io.outputs[:, 0]

    def observations(self) -> NDArray[np.float32]:
        """Return a copy of the current observations (n, features)."""
        return self.read(self.at.observation, np.float32)[:, self._shown]


def _base_from(agent: Any) -> Policy:
    """Return the agent that the argument ``base`` of an environment made, as a policy."""
    try:
        return policy_from(agent)
    except ValueError as error:
        raise ValueError(f"base: {error}") from error
