"""A function of numbers, compiled to run epoch after epoch for many environments.

A program maps a workspace tree to a workspace tree. Its leaves are rows of an array
(blocks, rows, 8), eight environments to a block. The first field of a workspace,
``incoming``, is loaded before each run from a table of whole tracks.
"""

import threading
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from mmwave_env.estimator.lanes import WIDTH, kernel
from mmwave_env.estimator.trees import Tree, leaves, rebuild

Workspace = TypeVar("Workspace", bound=tuple[Any, ...])
Array = NDArray[np.float64]
Index = NDArray[np.int64]

NO_ROWS = np.empty(0, np.int64)
_COMPILING = threading.Lock()


class Tracks(NamedTuple):
    """N tracks and how far they are.

    Attributes:
        rows: (blocks, size, 8) workspace, changed in place.
        table: (n, epochs, incoming) what to load.
        length: (n,) epochs there are of each track; past them a blank one is loaded.
        epoch: (n,) the epoch each runs next, changed in place.
        running: (n,) False leaves a track and its epoch as they are.
    """

    rows: Array
    table: Array
    length: Index
    epoch: Index
    running: NDArray[np.bool_]

    @classmethod
    def of(cls, table: Array, rows: Array) -> "Tracks":
        """Tracks of equal length, from their first epoch."""
        n, epochs, _ = table.shape
        return cls(rows, table, np.full(n, epochs), np.zeros(n, np.int64), np.ones(n, np.bool_))

    def blocks(self, first: int, end: int) -> "Tracks":
        """The tracks of some of the blocks, sharing memory."""
        rows, table, length, epoch, running = self
        some = slice(first * WIDTH, end * WIDTH)
        return Tracks(rows[first:end], table[some], length[some], epoch[some], running[some])


def tree_kernel(function: Callable[[Tree], Tree], template: Tree) -> Any:
    """A numba function of a (rows, 8) block that changes it by a function of numbers.

    Args:
        function: from a tree to a tree of the same shape.
        template: a tree of that shape; its leaves in order are the rows.
    """

    def build(rows: Any) -> None:
        before = [rows[i] for i in range(len(leaves(template)))]
        after = leaves(function(rebuild(template, iter(before))))
        for i, (old, new) in enumerate(zip(before, after, strict=True)):
            if new is not old:
                rows[i] = new

    return kernel(build)


class Program(Generic[Workspace]):
    """A function of numbers with its workspace, compiled at its first run on lanes.

    Args:
        function: from a workspace tree to a workspace tree of the same shape.
        template: a workspace of floats, the initial value; its ``incoming`` is the blank epoch.
    """

    def __init__(self, function: Callable[[Workspace], Workspace], template: Workspace) -> None:
        self.function, self.template = function, template
        self.start = np.array(leaves(template), float)
        self.blank = np.array(leaves(template[0]), float)
        self.size = len(self.start)
        self.index: Workspace = rebuild(template, iter(range(self.size)))
        self._on_lanes: Any = None

    def run_on_lanes(
        self, tracks: Tracks, feed: Index, given: Array, keep: Index, kept: Array
    ) -> None:
        """Run epoch after epoch, eight environments at a time.

        Args:
            tracks: what to run.
            feed: (f,) rows to set before every epoch.
            given: (n, epochs, f) their values.
            keep: (k,) rows to keep after every epoch.
            kept: (n, epochs, k) gets them; its length is the number of epochs to run.
        """
        with _COMPILING:
            if self._on_lanes is None:
                self._on_lanes = self._compile()
        self._on_lanes(*tracks, feed, given, keep, kept)

    def run_on_floats(
        self, tracks: Tracks, feed: Index, given: Array, keep: Index, kept: Array
    ) -> None:
        """The same, one environment at a time in plain Python: slow, for reference."""
        rows, table, length, epoch, running = tracks
        for e in np.flatnonzero(running):
            lanes = rows[e // WIDTH, :, e % WIDTH]
            for step in range(kept.shape[1]):
                t = epoch[e] + step
                lanes[: len(self.blank)] = table[e, t] if t < length[e] else self.blank
                lanes[feed] = given[e, step]
                workspace = rebuild(self.template, iter(lanes.tolist()))
                lanes[:] = leaves(self.function(workspace))
                kept[e, step] = lanes[keep]
            epoch[e] += kept.shape[1]

    def _compile(self) -> Any:
        blank = self.blank
        run = tree_kernel(self.function, self.template)

        @numba.njit(nogil=True)  # type: ignore[untyped-decorator]
        def load(block, lane, table, t, length, feed, given):  # type: ignore[no-untyped-def]
            for i in range(len(blank)):
                block[i, lane] = table[t, i] if t < length else blank[i]
            for i in range(len(feed)):
                block[feed[i], lane] = given[i]

        @numba.njit(nogil=True)  # type: ignore[untyped-decorator]
        def advance(  # type: ignore[no-untyped-def]
            rows, table, length, epoch, running, feed, given, keep, kept
        ):
            n, steps = kept.shape[:2]
            for b in range(len(rows)):
                block, first = rows[b], b * WIDTH
                here = min(WIDTH, n - first)
                busy = running[first : first + here].sum()
                if busy == 0:
                    continue
                before = block.copy() if busy < here else block[:0].copy()
                for step in range(steps):
                    for lane in range(WIDTH):  # those past n run their block's first track
                        e = first + lane if lane < here else first
                        load(
                            block, lane, table[e], epoch[e] + step, length[e], feed, given[e, step]
                        )
                    run(block)
                    for lane in range(here):
                        if running[first + lane]:
                            for i in range(len(keep)):
                                kept[first + lane, step, i] = block[keep[i], lane]
                for lane in range(here):
                    if running[first + lane]:
                        epoch[first + lane] += steps
                    else:
                        block[:, lane] = before[:, lane]

        return advance
