"""Run a program on episodes, for a batch of environments.

The workspace of such a program begins with three fields that a :class:`Batch` fills in:
``incoming``, the next epoch (:class:`~mmwave_env.world.episode.Incoming`); ``site``; and
``is_first``, 1 where an episode begins, which the program sets back to 0.
"""

from collections.abc import Callable, Sequence
from typing import Any, Generic

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import (
    NO_ROWS,
    BatchState,
    Program,
    StepIO,
    Workspace,
    blocks_of,
)
from mmwave_env.compiler.threads import share, spans
from mmwave_env.models.measurement import Layout
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import Episode, EpisodeBatch, columns_of
from mmwave_env.world.simulated import Begun, SimulatedSource

BLOCKS_PER_THREAD = 64  # waking a thread costs as much as 32 of them


class Batch(Generic[Workspace]):
    """N environments running one program.

    Args:
        program: what runs.
        layout: rows of the measurements.
        n: number of environments.
        input_rows: leaves of ``program.index`` that are given a value for every epoch.
        on_floats: run in plain Python instead of on lanes.
        threads: how many may work at once; results do not depend on it.

    Attributes:
        at: the workspace tree with row numbers as leaves, to say what to read.
        state: the environments' workspaces, episodes and next epochs.
        parts: first block and end of what each thread does of an epoch.
    """

    def __init__(
        self,
        program: Program[Workspace],
        layout: Layout,
        n: int,
        input_rows: Index = NO_ROWS,
        on_floats: bool = False,
        threads: int = 1,
    ) -> None:
        self.program, self.layout, self.n = program, layout, n
        self.at = program.index
        blocks = -(-n // WIDTH)
        rows = blocks_of(program.start, n)
        self.state = BatchState.of(np.empty((n, 0, len(program.blank))), rows)
        self._input_rows = input_rows
        self._run: Callable[..., None] = (
            program.run_on_floats if on_floats else program.run_on_lanes
        )
        parts = 1 if on_floats else max(1, min(threads, blocks // BLOCKS_PER_THREAD))
        self.parts = spans(blocks, parts)

    def load(
        self,
        episodes: EpisodeBatch | Sequence[Episode],
        places: Index | None = None,
        gap_s: float | None = None,
    ) -> None:
        """Load episodes, to start over or to go on with.

        Args:
            episodes: one for each of the places.
            places: the environments to load; None for all.
            gap_s: seconds since the last epoch run, for episodes that continue the track;
                None to start over from their priors.

        Raises:
            ValueError: another layout than the batch's.
        """
        found = EpisodeBatch.of(episodes, self.layout)
        places = np.arange(self.n) if places is None else places
        epochs = found.table.shape[1]
        self.make_room(epochs)
        self.state.length[places] = found.length
        self.state.table[places, :epochs] = found.table
        if gap_s is not None:
            self.state.table[places, 0, columns_of(self.layout).dt] = gap_s
            self.state.epoch[places] = 0
            return
        _, site, _, *_ = self.at
        self.write(site, found.site, places)
        self.restart(places)

    def begin(self, source: SimulatedSource, begun: Begun, places: Index) -> None:
        """Start over with episodes that are simulated as the environments go.

        Args:
            source: of the episodes, the same always.
            begun: what each of the places begins with.
            places: the environments to begin.
        """
        self.attach(source)
        block, lane = np.divmod(places, WIDTH)
        self.state.feed.kept[block, :, lane] = begun.worlds
        self.state.length[places] = source.epochs
        _, site, _, *_ = self.at
        self.write(site, begun.sites, places)
        self.restart(places)

    def attach(self, source: SimulatedSource) -> None:
        """Have the episodes of a source simulated from the next :meth:`begin` on."""
        if not self.state.feed.run:
            blank = source.begin(np.zeros(1, np.uint64)).worlds
            feed = source.feed(np.tile(blank, (self.n, 1)))
            self.state = self.state._replace(feed=feed)

    def make_room(self, epochs: int) -> None:
        """For tables of so many epochs; those loaded stay."""
        table = self.state.table
        n, had, columns = table.shape
        if epochs > had:
            longer = np.empty((n, epochs, columns))
            longer[:, :had] = table
            self.state = self.state._replace(table=longer)

    def restart(self, places: Index | None = None) -> None:
        """Start over with the episodes loaded; ``places`` as in :meth:`load`."""
        places = np.arange(self.n) if places is None else places
        _, _, is_first, *_ = self.at
        self.write(is_first, 1.0, places)
        self.state.epoch[places] = 0

    def episodes(self, places: Index) -> EpisodeBatch:
        """The episodes loaded in some environments, without their names."""
        _, site, *_ = self.at
        block, lane = np.divmod(places, WIDTH)
        length = self.state.length[places]
        return EpisodeBatch(
            names=[""] * len(places),
            nonfinite=np.zeros(len(places), np.int64),
            length=length,
            table=self.state.table[places, : length.max(initial=0)],
            site=self.state.rows[block, self.span(site), lane],
            layout=self.layout,
        )

    def io(
        self, epochs: int = 1, output_rows: Index = NO_ROWS, obs_rows: Index = NO_ROWS
    ) -> StepIO:
        """What a run of some epochs needs: zeros to feed, and room for rows to keep or show."""
        return StepIO.of(self.n, epochs, self._input_rows, output_rows, obs_rows)

    def advance(self, io: StepIO | None = None, running: NDArray[np.bool_] | None = None) -> None:
        """Run the next epochs; past the end of an episode epochs are blank.

        Args:
            io: what to feed, keep and show; None for one epoch of none.
            running: (n,) False for the environments to leave as they are; None for none.
        """
        io = self.io() if io is None else io
        state = self.state if running is None else self.state._replace(running=running)
        if len(self.parts) == 1:
            self._run(state, io)
        else:
            share(self._run, [(state, io, part) for part in self.parts], len(self.parts))

    def span(self, tree: Any) -> slice:
        """The rows of a subtree of ``at``; leaves of a subtree lie side by side."""
        numbers = flatten(tree)
        return slice(numbers[0], numbers[-1] + 1)

    def read(self, tree: Any, dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """The rows of a subtree of ``at``, or of its span: a copy, (n,) of a leaf, else (n, k)."""
        rows = self.state.rows
        if isinstance(tree, int):
            return rows[:, tree, :].reshape(-1)[: self.n].astype(dtype)
        span = tree if isinstance(tree, slice) else self.span(tree)
        chosen = rows[:, span, :].transpose(0, 2, 1).astype(dtype, order="C")
        return chosen.reshape(-1, chosen.shape[2])[: self.n]

    def column(self, environment: int) -> Array:
        """All rows of one environment (size,), as a copy; :meth:`span` says where what is."""
        block, lane = divmod(environment, WIDTH)
        return self.state.rows[block, :, lane].copy()

    def write(self, tree: Any, values: Any, places: Index | None = None) -> None:
        """Set the rows named by a subtree of ``at``: values (n,) of a leaf, else (n, leaves).

        There is a value for each of the places, which are as in :meth:`load`.
        """
        places = np.arange(self.n) if places is None else places
        block, lane = np.divmod(places, WIDTH)
        rows = tree if isinstance(tree, int) else self.span(tree)
        self.state.rows[block, rows, lane] = values
