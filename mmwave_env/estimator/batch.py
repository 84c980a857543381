"""Run a program on episodes, for a batch of environments.

A :class:`Batch` loads :class:`Incoming` epochs of episodes and fills in the next two fields of
a workspace as well: ``site``, and ``fresh``, 1 where an episode begins; the program sets it
back to 0.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Generic, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mmwave_env.arithmetic import Number, where
from mmwave_env.episode import Episode
from mmwave_env.estimator.lanes import WIDTH
from mmwave_env.estimator.pipeline import Epoch, Site
from mmwave_env.estimator.program import NO_ROWS, Array, Index, Program, Tracks, Workspace
from mmwave_env.estimator.trees import leaves
from mmwave_env.measurement import STATE_SIZE, Layout
from mmwave_env.threads import share

BLOCKS_PER_THREAD = 64  # waking a thread costs as much as 16 of them


class Incoming(NamedTuple):
    """What is loaded from an episode, a row of :meth:`Episode.table`.

    Attributes:
        dt, z, snr_db, doppler_spread_hz: as in :class:`Epoch`.
        signed_sigma: (rows,) standard deviations, negative where the group is missing.
        truth: (6,) true position (m) and velocity (m/s), to score against.
    """

    dt: Number
    z: list[Number]
    signed_sigma: list[Number]
    snr_db: list[Number]
    doppler_spread_hz: Number
    truth: list[Number]

    def epoch(self, layout: Layout) -> Epoch:
        """What the estimator sees of it."""
        first = [self.signed_sigma[rows.start] for rows in layout.groups]
        visible = [where(sigma > 0.0, 1.0, 0.0) for sigma in first]
        sigma = [abs(sigma) for sigma in self.signed_sigma]
        return Epoch(self.dt, self.z, sigma, visible, self.snr_db, self.doppler_spread_hz)


def blank_incoming(layout: Layout) -> Incoming:
    """An epoch that measures nothing."""
    nothing = [0.0] * layout.size
    return Incoming(0.0, nothing, [-1.0] * layout.size, [0.0] * layout.anchors, 0.0, [0.0] * 6)


def blank_site(layout: Layout) -> Site:
    """A site that is sound but nowhere, to be overwritten."""
    prior = [float(i == j) for i in range(STATE_SIZE) for j in range(i + 1)]
    anchors = [[0.0, 0.0, 10.0 + a] for a in range(layout.anchors)]
    return Site(anchors, 1.0, [1.0] * STATE_SIZE, prior)


class Batch(Generic[Workspace]):
    """N environments running one program.

    Args:
        program: what runs.
        layout: rows of the measurements.
        n: number of environments.
        feed: leaves of ``program.index`` that are given a value for every epoch.
        on_floats: run in plain Python instead of on lanes.
        threads: how many may work at once; results do not depend on it.

    Attributes:
        at: the workspace tree with row numbers as leaves, to say what to read.
        tracks: the environments' workspaces, episodes and next epochs.
    """

    def __init__(
        self,
        program: Program[Workspace],
        layout: Layout,
        n: int,
        feed: Index = NO_ROWS,
        on_floats: bool = False,
        threads: int = 1,
    ) -> None:
        self.program, self.layout, self.n = program, layout, n
        self.at = program.index
        blocks = -(-n // WIDTH)
        rows = np.tile(program.start[None, :, None], (blocks, 1, WIDTH))
        self.tracks = Tracks.of(np.empty((n, 0, len(program.blank))), rows)
        self._feed = feed
        self._on_floats = on_floats
        self._parts = 1 if on_floats else max(1, min(threads, blocks // BLOCKS_PER_THREAD))

    def load(
        self, episodes: Sequence[Episode], places: Index | None = None, gap_s: float | None = None
    ) -> None:
        """Load episodes, to start over or to go on with.

        Args:
            episodes: one for each of the places.
            places: the environments to load; None for all.
            gap_s: seconds since the last epoch run, for episodes that continue the track;
                None to start over from their priors.

        Raises:
            ValueError: another number of episodes, or another layout than the batch's.
        """
        places = np.arange(self.n) if places is None else places
        if len(episodes) != len(places):
            raise ValueError(f"episodes: found {len(episodes)}, expected {len(places)}")
        for episode in episodes:
            if episode.layout != self.layout:
                raise ValueError(
                    f"layout of episode {episode.name!r}: found {episode.layout}, expected "
                    f"{self.layout}"
                )
        self._make_room(max(len(episode) for episode in episodes))
        for place, episode in zip(places, episodes, strict=True):
            self.tracks.length[place] = len(episode)
            self.tracks.table[place, : len(episode)] = episode.table()
        if gap_s is not None:
            self.tracks.table[places, 0, 0] = gap_s
            self.tracks.epoch[places] = 0
            return
        _, site, _, *_ = self.at
        self.write(site, np.stack([episode.site() for episode in episodes]), places)
        self.restart(places)

    def _make_room(self, epochs: int) -> None:
        table = self.tracks.table
        n, had, columns = table.shape
        if epochs > had:
            longer = np.empty((n, epochs, columns))
            longer[:, :had] = table
            self.tracks = self.tracks._replace(table=longer)

    def restart(self, places: Index | None = None) -> None:
        """Start over with the episodes loaded; ``places`` as in :meth:`load`."""
        places = np.arange(self.n) if places is None else places
        _, _, fresh, *_ = self.at
        self.write(fresh, 1.0, places)
        self.tracks.epoch[places] = 0

    def again(self, places: Index) -> "Batch[Workspace]":
        """A batch of some environments' episodes, about to start over."""
        other = Batch(self.program, self.layout, len(places), self._feed, self._on_floats)
        tracks, (_, site, *_) = self.tracks, self.at
        rows = tracks.rows[(places // WIDTH)[:, None], leaves(site), (places % WIDTH)[:, None]]
        other.tracks = other.tracks._replace(
            table=tracks.table[places], length=tracks.length[places]
        )
        other.write(site, rows)
        other.restart()
        return other

    def begin(self, episodes: Sequence[Episode]) -> None:
        """Load one episode each and run their first epoch; see :meth:`load`."""
        self.load(episodes)
        self.advance()

    def advance(
        self,
        given: Array | None = None,
        keep: Index = NO_ROWS,
        kept: Array | None = None,
        running: NDArray[np.bool_] | None = None,
    ) -> None:
        """Run the next epochs; past the end of an episode epochs are blank.

        Args:
            given: (n, epochs, fed rows) values of the rows that are fed; None for zeros.
            keep: (k,) rows to keep.
            kept: (n, epochs, k) gets them after every epoch; None for one epoch, nothing kept.
            running: (n,) False for the environments to leave as they are; None for none.
        """
        kept = np.empty((self.n, 1, 0)) if kept is None else kept
        if given is None:
            given = np.zeros((self.n, kept.shape[1], len(self._feed)))
        tracks = self.tracks if running is None else self.tracks._replace(running=running)
        if self._on_floats:
            self.program.run_on_floats(tracks, self._feed, given, keep, kept)
            return
        run = self.program.run_on_lanes
        if self._parts == 1:
            run(tracks, self._feed, given, keep, kept)
            return
        edges = [len(tracks.rows) * i // self._parts for i in range(self._parts + 1)]
        jobs = []
        for first, end in pairwise(edges):
            some = slice(first * WIDTH, end * WIDTH)
            jobs.append((tracks.blocks(first, end), self._feed, given[some], keep, kept[some]))
        share(run, jobs, self._parts)

    def record(self, tree: Any, epochs: int, given: Array | None = None) -> Array:
        """Run the next epochs and keep some rows of each.

        Args:
            tree: parts of ``at``.
            epochs: how many.
            given: as in :meth:`advance`.

        Returns:
            (n, epochs, leaves of the tree).
        """
        keep = np.array(leaves(tree), np.int64)
        kept = np.empty((self.n, epochs, len(keep)))
        self.advance(given, keep, kept)
        return kept

    def span(self, tree: Any) -> slice:
        """The rows of a subtree of ``at``; leaves of a subtree lie side by side."""
        numbers = leaves(tree)
        return slice(numbers[0], numbers[-1] + 1)

    def read(self, tree: Any, dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """The rows of a subtree of ``at``, or of its span: a copy, (n,) of a leaf, else (n, k)."""
        rows = self.tracks.rows
        if isinstance(tree, int):
            return rows[:, tree, :].reshape(-1)[: self.n].astype(dtype)
        span = tree if isinstance(tree, slice) else self.span(tree)
        chosen = rows[:, span, :].transpose(0, 2, 1).astype(dtype, order="C")
        return chosen.reshape(-1, chosen.shape[2])[: self.n]

    def column(self, environment: int) -> Array:
        """All rows of one environment (size,), as a copy; :meth:`span` says where what is."""
        block, lane = divmod(environment, WIDTH)
        return self.tracks.rows[block, :, lane].copy()

    def write(self, tree: Any, values: Any, places: Index | None = None) -> None:
        """Set the rows named by a subtree of ``at``: values (n,) of a leaf, else (n, leaves).

        Args:
            tree: a part of ``at``.
            values: for each of the places.
            places: as in :meth:`load`.
        """
        places = np.arange(self.n) if places is None else places
        block, lane = np.divmod(places, WIDTH)
        if isinstance(tree, int):
            self.tracks.rows[block, tree, lane] = values
        else:
            self.tracks.rows[block[:, None], leaves(tree), lane[:, None]] = values
