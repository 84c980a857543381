"""Replays of finished episodes, forwards and backwards, with the modes that were chosen.

An environment does not store its track. To get it, a finished episode is run again with the same
actions. The forward pass gives errors and NEES, the backward pass gives smoothed errors (paper,
Sec. III-F). Tracks that were stored need only smoothing (:func:`smooth`).
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.advance import call
from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, fill, rows_of
from mmwave_env.compiler.transpose import address, gather, pick
from mmwave_env.engines.imm_engine import ImmState, imm_program
from mmwave_env.engines.track_engine import TrackState, program_of
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.pipeline import VERTICAL, Pipeline
from mmwave_env.filters.smoother import (
    BackwardState,
    ForwardEpoch,
    blank_epoch,
    smooth_epoch,
    smooth_mean,
    track_end,
)
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.numerics.numbers import Array, Index, Number
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import EpisodeBatch

Actions = NDArray[np.integer[Any]]

AXES = 3


class ReplayedEpoch(NamedTuple):
    """The parts of an epoch that the backward pass needs."""

    filtered: ForwardEpoch  # the epoch's step, and its predicted and filtered beliefs
    error: list[Number]  # (3,) position error, m
    nees: Number  # NEES of the position


class BackwardPass(NamedTuple):
    """The state of the backward pass between two epochs."""

    incoming: ReplayedEpoch  # the current epoch
    after: BackwardState  # the following epoch, smoothed
    smoothed_error: list[Number]  # (3,) position error of the current epoch's smoothed mean, m


def _replayed(track: TrackState | ImmState, clock: bool) -> ReplayedEpoch:
    carrier = [track.site.hz_per_mps] if clock else ()
    filtered = ForwardEpoch(
        track.incoming.dt, track.x, track.P, track.x_predicted, track.P_predicted, carrier
    )
    return ReplayedEpoch(filtered, track.error, track.nees)


@lru_cache(maxsize=4)
def _backward_program(known_axes: tuple[int, ...], size: int) -> Program[BackwardPass]:
    def function(w: BackwardPass) -> BackwardPass:
        (filtered, error, _), after = w.incoming, w.after
        after = smooth_mean(filtered, after, known_axes)
        moved = [e + (after.x[i] - filtered.x[i]) for i, e in enumerate(error)]
        return BackwardPass(w.incoming, after, moved)

    blank = ReplayedEpoch(blank_epoch(size), [0.0] * AXES, 0.0)
    end = track_end(with_covariance=False, size=size)
    return Program(function, BackwardPass(blank, end, blank.error))


class Replay:
    """A replay of finished episodes of a pipeline.

    Args:
        pipeline: modes and layout.
        bank: bank of the modes, if every mode keeps its own belief; None if they share a belief.
    """

    def __init__(self, pipeline: Pipeline, bank: Bank | None = None) -> None:
        self._forward: Program[Any]
        if bank:
            self._forward = imm_program(pipeline, TrackingReward(), acted=True)
            tuned: Any = self._forward.index.settings
            numbers = flatten(settings_of(bank, pipeline.layout))
        else:
            self._forward = program_of(pipeline)
            tuned = self._forward.index.tunings
            numbers = flatten([mode.tuning for mode in pipeline.modes])
        layout = pipeline.layout
        self._backward = _backward_program(pipeline.known_axes, layout.state_size)
        at = self._backward.index
        self._start = self._forward.start.copy()
        self._start[rows_of(tuned)] = numbers
        self._keep = rows_of(_replayed(self._forward.index, layout.clock))
        self._show = rows_of([at.incoming.error, at.incoming.nees, at.smoothed_error])

    def run(self, episodes: EpisodeBatch, actions: Actions) -> tuple[Array, ...]:
        """Run finished episodes again, forwards and backwards.

        The results for an episode do not depend on the other episodes, not even by rounding.

        Args:
            episodes: n episodes.
            actions: (n, T) modes chosen in the first T epochs of each episode.

        Returns:
            Filtered position errors (n, T, 3), m; NEES (n, T); smoothed position errors (n, T, 3).
        """
        forward, backward = self._forward, self._backward
        site = rows_of(forward.index.site)
        rows = fill(blocks_of(self._start, len(actions)), site, episodes.site)
        figures = np.empty((len(self._show), *actions.shape))  # contiguous, so that sums are fast
        _both_ways(
            ReplayCode(forward.on_lanes(), forward.index.action, self._keep),
            ReplayCode(backward.on_lanes(), 0, self._show),
            rows,
            backward.start,
            episodes.table,
            actions,
            figures,
        )
        error, nees, smoothed = figures[:AXES], figures[AXES], figures[AXES + 1 :]
        return np.moveaxis(error, 0, -1), nees, np.moveaxis(smoothed, 0, -1)


class ReplayCode(NamedTuple):
    """A compiled program for a pass over the epochs."""

    run: int  # address of the program
    action: int  # number of the action's row, if the program needs an action
    rows: Index  # (k,) numbers of the rows to keep in each epoch


@register_jitable  # type: ignore[untyped-decorator]
def _run_backwards(backward, start, kept, out):  # type: ignore[no-untyped-def]
    """Run up to eight episodes backwards from their last epoch; fill ``out`` (s, n, T)."""
    block, (run, _, shown) = np.empty((len(start), WIDTH)), backward
    for i in range(len(start)):
        for lane in range(WIDTH):
            block[i, lane] = start[i]
    for t in range(len(kept) - 1, -1, -1):
        for i in range(kept.shape[1]):
            for lane in range(WIDTH):
                block[i, lane] = kept[t, i, lane]
        call(run, block)
        for i in range(len(shown)):
            for e in range(out.shape[1]):
                out[i, e, t] = block[shown[i], e]


@compiled
def _both_ways(forward, backward, rows, start, tables, actions, out):  # type: ignore[no-untyped-def]
    """Run eight episodes at a time forwards and backwards, so that kept epochs stay in a cache."""
    (n, epochs), (run, action, picked) = actions.shape, forward
    kept = np.empty((epochs, len(picked), WIDTH))
    sources = np.empty(WIDTH, np.int64)
    for b in range(len(rows)):
        block, first = rows[b], b * WIDTH
        end = min(first + WIDTH, n)
        for t in range(epochs):
            for lane in range(WIDTH):  # lanes past n run the first episode of their block
                e = first + lane if first + lane < end else first
                sources[lane] = address(tables, e, t)
                block[action, lane] = actions[e, t]
            gather(block, sources, tables.shape[2])
            call(run, block)
            pick(block, picked, kept[t])
        _run_backwards(backward, start, kept, out[:, first:end])


class SmoothingState(NamedTuple):
    """The state of the smoother between two epochs of the backward pass."""

    incoming: ForwardEpoch  # the current epoch
    after: BackwardState  # the following epoch, smoothed


@lru_cache(maxsize=4)
def _program(known_axes: tuple[int, ...], size: int) -> Program[SmoothingState]:
    def function(w: SmoothingState) -> SmoothingState:
        return w._replace(after=smooth_epoch(w.incoming, w.after, known_axes))

    end = track_end(with_covariance=True, size=size)
    return Program(function, SmoothingState(blank_epoch(size), end))


def smooth(
    x: Array,
    P: Array,
    x_predicted: Array,
    P_predicted: Array,
    dt: Array,
    planar: bool = False,
    hz_per_mps: float = np.nan,
) -> tuple[Array, Array]:
    """Return smoothed means (N, T, 7) and packed covariances (N, T, 28) of finished tracks.

    Args:
        x: (N, T, 7) filtered means.
        P: (N, T, 28) filtered covariances, packed.
        x_predicted, P_predicted: (N, T, 7), (N, T, 28) beliefs predicted for each epoch, before its
            update.
        dt: (T - 1,) seconds from each epoch to the next; (N, T - 1) if they differ between tracks.
        planar: whether z and vz are known exactly.
        hz_per_mps: carrier frequency over the speed of light; needed only with a clock.
    """
    N, T, size = x.shape
    program = _program(VERTICAL if planar else (), size)
    since = np.ones((N, T))
    since[:, 1:] = dt
    carrier = np.full((N, T, size - STATE_SIZE), hz_per_mps)
    forwards = np.concatenate([since[..., None], x, P, x_predicted, P_predicted, carrier], axis=2)
    rows = blocks_of(program.start, N)
    io = StepIO.of(N, T, output_rows=rows_of([program.index.after.x, program.index.after.P]))
    backwards = np.ascontiguousarray(forwards[:, ::-1])
    program.run_on_lanes(BatchState.of(backwards, rows), io)
    smoothed = io.outputs[:, ::-1]
    return smoothed[..., :size].copy(), smoothed[..., size:].copy()
