"""Run a function of numbers for a batch of environments, on SIMD lanes or on floats.

A program maps a workspace tree to a workspace tree. Its leaves are rows of an array
(blocks, rows, 8), eight environments to a block. The first field of a workspace,
``incoming``, is loaded before each run from a table of whole tracks. A :class:`Batch` loads
:class:`Incoming` epochs of episodes and fills in the next two fields as well: ``site``, and
``fresh``, 1 where an episode begins; the program sets it back to 0.
"""

from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from mmwave_env.arithmetic import Number
from mmwave_env.episode import Episode
from mmwave_env.estimator.lanes import WIDTH, kernel
from mmwave_env.estimator.pipeline import Epoch, Site
from mmwave_env.estimator.trees import leaves, rebuild
from mmwave_env.measurement import STATE_SIZE, Layout

Workspace = TypeVar("Workspace", bound=tuple[Any, ...])
Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Incoming(NamedTuple):
    """What is loaded from an episode.

    Attributes:
        epoch: measurements.
        truth: (6,) true position (m) and velocity (m/s), to score against.
    """

    epoch: Epoch
    truth: list[Number]


def blank_incoming(layout: Layout) -> Incoming:
    """An epoch that measures nothing."""
    rows, groups = layout.size, len(layout.groups)
    epoch = Epoch(0.0, [0.0] * rows, [1.0] * rows, [0.0] * groups, [0.0] * layout.anchors, 0.0)
    return Incoming(epoch, [0.0] * 6)


def blank_site(layout: Layout) -> Site:
    """A site that is sound but nowhere, to be overwritten."""
    prior = [float(i == j) for i in range(STATE_SIZE) for j in range(i + 1)]
    anchors = [[0.0, 0.0, 10.0 + a] for a in range(layout.anchors)]
    return Site(anchors, 1.0, [1.0] * STATE_SIZE, prior)


class Program(Generic[Workspace]):
    """A function of numbers with its workspace, compiled at its first run on lanes.

    Args:
        function: from a workspace tree to a workspace tree of the same shape.
        template: a workspace of floats, the initial value.
    """

    def __init__(self, function: Callable[[Workspace], Workspace], template: Workspace) -> None:
        self.function, self.template = function, template
        self.size = len(leaves(template))
        self.incoming = len(leaves(template[0]))
        self.index: Workspace = rebuild(template, iter(range(self.size)))
        self._on_lanes: Any = None

    def run_on_lanes(
        self, rows: Array, table: Array, first: Index, record: Index, out: Array
    ) -> None:
        """Run epoch after epoch, eight environments at a time.

        Args:
            rows: (blocks, size, 8) workspace, changed in place.
            table: (n, epochs, incoming) episodes; lanes past n run environment 0's.
            first: (n,) the epoch to load first; past the last, the last is loaded again.
            record: (k,) the rows to keep.
            out: (n, steps, k) gets them after each of the steps.
        """
        if self._on_lanes is None:
            self._on_lanes = self._compile()
        self._on_lanes(rows, table, first, record, out)

    def run_on_floats(
        self, rows: Array, table: Array, first: Index, record: Index, out: Array
    ) -> None:
        """The same, one environment at a time in plain Python: slow, for reference."""
        for e in range(len(first)):
            block, lane = divmod(e, WIDTH)
            for step in range(out.shape[1]):
                epoch = min(first[e] + step, table.shape[1] - 1)
                rows[block, : self.incoming, lane] = table[e, epoch]
                workspace = rebuild(self.template, iter(rows[block, :, lane].tolist()))
                rows[block, :, lane] = leaves(self.function(workspace))
                out[e, step] = rows[block, record, lane]

    def _compile(self) -> Any:
        incoming = self.incoming

        def build(rows: Any) -> None:
            before = [rows[i] for i in range(self.size)]
            after = leaves(self.function(rebuild(self.template, iter(before))))
            for i, (old, new) in enumerate(zip(before, after, strict=True)):
                if new is not old:
                    rows[i] = new

        run = kernel(build)

        @numba.njit(nogil=True)  # type: ignore[untyped-decorator]
        def advance(rows: Array, table: Array, first: Index, record: Index, out: Array) -> None:
            n, last = len(first), table.shape[1] - 1
            for b in range(rows.shape[0]):
                block = rows[b]
                for step in range(out.shape[1]):
                    for lane in range(WIDTH):
                        e = b * WIDTH + lane if b * WIDTH + lane < n else 0
                        epoch = min(first[e] + step, last)
                        for i in range(incoming):
                            block[i, lane] = table[e, epoch, i]
                    run(block)
                    for lane in range(min(WIDTH, n - b * WIDTH)):
                        for i in range(len(record)):
                            out[b * WIDTH + lane, step, i] = block[record[i], lane]

        return advance


class Batch(Generic[Workspace]):
    """N environments running one program.

    Attributes:
        program: what runs.
        layout: rows of the measurements.
        n: number of environments.
        at: the workspace tree with row numbers as leaves, to say what to read.
        epoch: (n,) the epoch each environment runs next.
    """

    def __init__(
        self, program: Program[Workspace], layout: Layout, n: int, on_floats: bool = False
    ) -> None:
        self.program, self.layout, self.n = program, layout, n
        self.at = program.index
        self.epoch = np.zeros(n, np.int64)
        blocks = -(-n // WIDTH)
        start = np.array(leaves(program.template), float)
        self._rows = np.tile(start[None, :, None], (blocks, 1, WIDTH))
        self._table = np.zeros((n, 1, program.incoming))
        self._run = program.run_on_floats if on_floats else program.run_on_lanes
        self._nothing = np.empty(0, np.int64), np.empty((n, 1, 0))

    def load(self, episodes: Sequence[Episode], gap_s: float | None = None) -> None:
        """Load one episode each, to start over or to go on with.

        Args:
            episodes: one for each environment.
            gap_s: seconds since the last epoch run, for episodes that continue the track;
                None to start over from their priors.

        Raises:
            ValueError: another number of episodes, or another layout than the batch's.
        """
        if len(episodes) != self.n:
            raise ValueError(f"episodes: found {len(episodes)}, expected {self.n}")
        for episode in episodes:
            if episode.layout != self.layout:
                raise ValueError(
                    f"layout of episode {episode.name!r}: found {episode.layout}, expected "
                    f"{self.layout}"
                )
        epochs = max(len(episode) for episode in episodes) + 1
        self._table = np.stack([episode.table(epochs) for episode in episodes])
        if gap_s is not None:
            self._table[:, 0, 0] = gap_s
            self.epoch[:] = 0
            return
        _, site, _, *_ = self.at
        self.write(site, np.stack([episode.site() for episode in episodes]))
        self.restart()

    def restart(self) -> None:
        """Start over with the episodes loaded."""
        _, _, fresh, *_ = self.at
        self.write(fresh, np.ones(self.n))
        self.epoch[:] = 0

    def begin(self, episodes: Sequence[Episode]) -> None:
        """Load one episode each and run their first epoch; see :meth:`load`."""
        self.load(episodes)
        self.advance()

    def advance(self) -> None:
        """Run the next epoch; past the end of an episode epochs are blank."""
        self._run(self._rows, self._table, self.epoch, *self._nothing)
        self.epoch += 1

    def record(self, tree: Any, epochs: int) -> Array:
        """Run the next epochs and keep some rows of each.

        Args:
            tree: parts of ``at``.
            epochs: how many.

        Returns:
            (n, epochs, leaves of the tree).
        """
        rows = np.array(leaves(tree), np.int64)
        out = np.empty((self.n, epochs, len(rows)))
        self._run(self._rows, self._table, self.epoch, rows, out)
        self.epoch += epochs
        return out

    def span(self, tree: Any) -> slice:
        """The rows of a subtree of ``at``; leaves of a subtree lie side by side."""
        numbers = leaves(tree)
        return slice(numbers[0], numbers[-1] + 1)

    def read(self, tree: Any) -> Array:
        """The rows named by a subtree of ``at``, as a copy: (n,) of a leaf, else (n, leaves)."""
        if isinstance(tree, int):
            return self._rows[:, tree, :].reshape(-1)[: self.n].copy()
        chosen = self._rows[:, self.span(tree), :].transpose(0, 2, 1)
        return np.ascontiguousarray(chosen).reshape(-1, chosen.shape[2])[: self.n]

    def column(self, environment: int) -> Array:
        """All rows of one environment (size,), as a copy; :meth:`span` says where what is."""
        block, lane = divmod(environment, WIDTH)
        return self._rows[block, :, lane].copy()

    def write(self, tree: Any, values: Any) -> None:
        """Set the rows named by a subtree of ``at``: values (n,) of a leaf, else (n, leaves)."""
        if isinstance(tree, int):
            self._rows[:, tree, :].flat[: self.n] = values
            return
        for row, column in zip(leaves(tree), values.T, strict=True):
            self._rows[:, row, :].flat[: self.n] = column
