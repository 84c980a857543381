"""Batches of environments that run a program on episodes.

A program (:mod:`mmwave_env.compiler.program`) computes one epoch of an environment. Its workspace
contains the environment's state: numbers, called rows. A :class:`Batch` sets the first three fields
of the workspace: ``incoming`` is the next epoch; ``site`` contains the anchors, carrier and prior;
``is_first`` is 1 if an episode begins, and the program sets it back to 0.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mmwave_env.compiler.advance import advance
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import (
    NO_ROWS,
    BatchState,
    Feed,
    Program,
    Repeated,
    StepIO,
    blocks_of,
    spans,
)
from mmwave_env.models.layout import Layout
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import Episode, EpisodeBatch, columns_of
from mmwave_env.world.simulated import EpisodeStarts, SimulatedSource

# Waking a thread takes as long as running 32 blocks, of eight environments each, for one epoch.
BLOCKS_PER_THREAD = 64  # minimum number of blocks for each thread
_NO_FEED = Feed.none()

Places = Index | slice  # indices of environments
ALL = slice(None)


class Batch:
    """N environments running one program.

    Args:
        program: the program to run.
        layout: which quantity is in which row of a measurement.
        n: number of environments.
        input_rows: indices of the workspace's rows that receive an input in every epoch.
        obs_rows: indices of the rows that are observed after every epoch.
        on_floats: whether to run in plain Python instead of on SIMD lanes.
        threads: maximum number of threads in use; results do not depend on it.

    Attributes:
        at: workspace whose leaves are row indices; :meth:`read` and :meth:`write` take parts of it.
        state: the environments' workspaces and episodes, and the indices of their next epochs.
        parts: for each thread, the range of blocks that it runs: first block, last block + 1.
    """

    def __init__(
        self,
        program: Program[Any],
        layout: Layout,
        n: int,
        input_rows: Index,
        obs_rows: Index,
        on_floats: bool = False,
        threads: int = 1,
    ) -> None:
        self.program = program
        self.layout = layout
        self.n = n
        self.at: Any = program.index
        blocks = -(-n // WIDTH)
        rows = blocks_of(program.start, n)
        self.state = BatchState.of(np.empty((n, 0, len(program.blank))), rows)
        self._input_rows = input_rows
        self.obs_rows = obs_rows
        self.on_floats = on_floats
        self._run = Repeated(advance)
        self._over = np.zeros(n, np.int64)  # epochs and lengths of tracks that load no epoch
        self.parts = spans(blocks, max(1, min(threads, blocks // BLOCKS_PER_THREAD)))

    def load(self, episodes: EpisodeBatch | Sequence[Episode], places: Places = ALL) -> None:
        """Load episodes, to be filtered from their priors.

        Args:
            episodes: one episode for each environment in ``places``.
            places: indices of the environments to load.

        Raises:
            ValueError: the layout of an episode differs from the batch's.
        """
        packed = EpisodeBatch.of(episodes, self.layout)
        epochs = packed.table.shape[1]
        self.make_room(epochs)
        self.state.length[places] = packed.length
        self.state.table[places, :epochs] = packed.table
        self.write(self.at.site, packed.site, places)
        self.restart(places)

    def go_on(self, table: Any) -> None:
        """Load T more epochs of each of the first k tracks.

        ``table`` (k, T, columns) has rows of :meth:`~mmwave_env.world.episode.Episode.table`, the
        first of them with the time since each track's previous epoch.
        """
        epochs = len(table[0])
        self.make_room(epochs)
        self.state.table[: len(table), :epochs] = table
        self.state.length[:] = epochs
        self.state.epoch[:] = 0

    def begin(self, source: SimulatedSource, starts: EpisodeStarts, places: Index) -> None:
        """Start over with episodes that are simulated while the environments step.

        Args:
            source: source of the episodes, the same in every call.
            starts: beginnings of the episodes, one for each of ``places``.
            places: indices of the environments that begin.
        """
        if not self.state.feed.run:
            self.state = self.state._replace(feed=source.feed(self.n))
        block, lane = np.divmod(places, WIDTH)
        self.state.feed.kept[block, :, lane] = starts.worlds
        self.state.length[places] = source.epochs
        self.write(self.at.site, starts.sites, places)
        self.restart(places)

    def make_room(self, epochs: int) -> None:
        """Make room for tables with this number of epochs; loaded tables are kept."""
        table = self.state.table
        n, had, columns = table.shape
        if epochs > had:
            longer = np.empty((n, epochs, columns))
            longer[:, :had] = table
            self.state = self.state._replace(table=longer)

    def restart(self, places: Places) -> None:
        """Start over with the loaded episodes; ``places`` is the same as in :meth:`load`."""
        self.write(self.at.is_first, 1.0, places)
        self.state.epoch[places] = 0

    def io(self, output_rows: Index = NO_ROWS, epochs: int = 1) -> StepIO:
        """Return buffers for this number of epochs: zeros as inputs, and arrays for results."""
        return StepIO.of(self.n, epochs, self._input_rows, output_rows, self.obs_rows)

    def advance(
        self,
        io: StepIO,
        places: Index | None = None,
        program: Program[Any] | None = None,
        again: bool = False,
    ) -> None:
        """Run the next epochs; past the end of an episode, epochs are blank (without measurements).

        Args:
            io: inputs, outputs and observations; if only some environments run, outputs and
                observations of the others are meaningless.
            places: indices of the environments to run; None to run all.
            program: another program with the same workspace; None for the batch's own.
            again: whether the program works on the epoch that ran last, so that no epoch is loaded.
        """
        program = program or self.program
        if places is None or len(places) == self.n:
            self._advance(self.parts, io, program, again)
            return
        blocks = np.unique(places // WIDTH)
        near = blocks[:, None] * WIDTH + np.arange(WIDTH)
        others = np.setdiff1d(near[near < self.n], places)  # in the same blocks; to be restored
        block, lane = np.divmod(others, WIDTH)
        epoch = self.state.epoch[others]
        arrays = [self.state.rows]
        if self.state.feed.run:
            arrays.append(self.state.feed.kept)
        before = [array[block, :, lane] for array in arrays]
        try:
            self._advance([(b, b + 1) for b in blocks.tolist()], io, program, again)
        finally:
            self.state.epoch[others] = epoch
            for array, values in zip(arrays, before, strict=True):
                array[block, :, lane] = values

    @property
    def _same(self) -> BatchState:
        """Return the state for a program that works on the epoch that ran last."""
        return BatchState(self.state.rows, _NO_FEED, self.state.table, self._over, self._over)

    def _advance(
        self, parts: list[tuple[int, int]], io: StepIO, program: Program[Any], again: bool
    ) -> None:
        """Run the next epochs of some ranges of blocks; arguments are as for :meth:`advance`."""
        state = self._same if again else self.state
        if self.on_floats:
            for begin, end in parts:
                program.run_on_floats(begin, end, state, io)
            return
        self._run(parts, len(self.parts), program.on_lanes(), program.blank, state, io)

    def steps_s(self, places: Index) -> Array:
        """Return the median time (n,) in seconds between the epochs of each loaded episode."""
        state = self.state
        dt = columns_of(self.layout).dt
        each = [state.table[place, 1 : state.length[place], dt] for place in places]
        return np.array([np.median(steps) if len(steps) else 1.0 for steps in each])

    def span(self, tree: Any) -> Any:
        """Return the row of a leaf of ``at``, or the slice of the rows of a subtree.

        A slice or an array of rows is returned as it is.
        """
        if isinstance(tree, int | slice | np.ndarray):
            return tree
        numbers = flatten(tree)  # these rows are contiguous
        return slice(numbers[0], numbers[-1] + 1)

    def read(self, tree: Any, dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """Return numbers: (n,) for a leaf of ``at``, (n, k) for a subtree or some k rows."""
        blocks = np.moveaxis(self.state.rows[:, self.span(tree)], -1, 1).astype(dtype, order="C")
        return blocks.reshape(-1, *blocks.shape[2:])[: self.n]

    def column(self, environment: int) -> Array:
        """Return a copy of an environment's numbers (size,), in the order of the rows."""
        block, lane = divmod(environment, WIDTH)
        return self.state.rows[block, :, lane].copy()

    def write(self, tree: Any, values: Any, places: Places = ALL) -> None:
        """Set the rows of a subtree of ``at`` to values: (n,) for a leaf, else (n, leaves).

        ``values`` has one entry for each environment in ``places``.
        """
        block, lane = np.divmod(np.arange(self.n)[places], WIDTH)
        self.state.rows[block, self.span(tree), lane] = values
