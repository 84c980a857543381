"""Run a function of numbers for a batch of environments, on SIMD lanes or on floats.

A program maps a workspace tree to a workspace tree. Its leaves are rows of an array
(blocks, rows, 8), eight environments to a block. The first field of a workspace,
``incoming``, is loaded before each run from a table of whole tracks. A :class:`Batch` loads
:class:`Incoming` epochs of episodes and fills in the next two fields as well: ``site``, and
``fresh``, 1 where an episode begins.
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

    def run_on_lanes(self, rows: Array, table: Array, epoch: NDArray[np.int64]) -> None:
        """Load each environment's epoch and run, eight environments at a time.

        Args:
            rows: (blocks, size, 8) workspace, changed in place.
            table: (n, epochs, incoming) episodes; lanes past n run environment 0's.
            epoch: (n,) which epoch to load.
        """
        if self._on_lanes is None:
            self._on_lanes = self._compile()
        self._on_lanes(rows, table, epoch)

    def run_on_floats(self, rows: Array, table: Array, epoch: NDArray[np.int64]) -> None:
        """The same, one environment at a time in plain Python: slow, for reference."""
        for e in range(len(epoch)):
            block, lane = divmod(e, WIDTH)
            rows[block, : self.incoming, lane] = table[e, epoch[e]]
            workspace = rebuild(self.template, iter(rows[block, :, lane].tolist()))
            rows[block, :, lane] = leaves(self.function(workspace))

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
        def advance(rows: Array, table: Array, epoch: NDArray[np.int64]) -> None:
            for b in range(rows.shape[0]):
                block = rows[b]
                for lane in range(WIDTH):
                    e = b * WIDTH + lane
                    if e >= len(epoch):
                        e = 0
                    for i in range(incoming):
                        block[i, lane] = table[e, epoch[e], i]
                run(block)

        return advance


class Batch(Generic[Workspace]):
    """N environments running one program.

    Attributes:
        program: what runs.
        layout: rows of the measurements.
        n: number of environments.
        at: the workspace tree with row numbers as leaves, to say what to read.
        epoch: (n,) the epoch each environment has loaded.
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

    def begin(self, episodes: Sequence[Episode]) -> None:
        """Load one episode each and run their first epoch.

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
        _, site, fresh, *_ = self.at
        self.write(site, np.stack([episode.site() for episode in episodes]))
        self.write(fresh, np.ones(self.n))
        self.epoch[:] = 0
        self._run(self._rows, self._table, self.epoch)
        self.write(fresh, np.zeros(self.n))

    def advance(self) -> None:
        """Load the next epoch and run; past the end of an episode epochs are blank."""
        np.minimum(self.epoch + 1, self._table.shape[1] - 1, out=self.epoch)
        self._run(self._rows, self._table, self.epoch)

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
