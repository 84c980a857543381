"""Smoothing of tracks, backwards in time (paper, Sec. III-F).

An environment does not store its track. To smooth the track, the finished episode is run again with
the modes that were chosen.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, rows_of
from mmwave_env.engines.engine import tracks_of
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.pipeline import VERTICAL, Pipeline
from mmwave_env.filters.smoother import (
    BackwardState,
    ForwardEpoch,
    blank_epoch,
    smooth_epoch,
    track_end,
)
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.numerics.numbers import Array, Number
from mmwave_env.world.episode import EpisodeBatch, columns_of

Actions = NDArray[np.integer[Any]]

_KEPT = ("x", "P", "x_predicted", "P_predicted", "error", "nees")


def smoothed_again(
    pipeline: Pipeline, bank: Bank | None, episodes: EpisodeBatch, actions: Actions
) -> tuple[Array, ...]:
    """Run finished episodes again with the actions that were chosen, and smooth them.

    The results for an episode do not depend on the other episodes, not even by rounding.

    Args:
        pipeline: modes and layout.
        bank: modes and transition probabilities, if every mode keeps its own belief; else None.
        episodes: n episodes.
        actions: (n, T) modes chosen in the first T epochs of each episode.

    Returns:
        Position errors (n, T, 3), m, and NEES (n, T) of the filtered tracks; position errors
        (n, T, 3) of the smoothed tracks.
    """
    n, T = actions.shape
    engine = tracks_of(pipeline, n, bank)
    engine.load(episodes._replace(table=episodes.table[:, :T], length=np.full(n, T)))
    x, P, x_predicted, P_predicted, error, nees = engine.run(*_KEPT, actions=actions).values()
    dt = episodes.table[:, 1:T, columns_of(pipeline.layout).dt]
    hz_per_mps = float(engine.read(engine.at.site.hz_per_mps)[0])
    drive = pipeline.layout.bias_drive(hz_per_mps)
    smoothed, _ = smooth(x, P, x_predicted, P_predicted, dt, pipeline.planar, drive)
    return error, nees, error + (smoothed - x)[..., :3]


class SmoothingState(NamedTuple):
    """The state of the smoother between two epochs of the backward pass."""

    incoming: ForwardEpoch  # the current epoch
    after: BackwardState  # the following epoch, smoothed


@lru_cache(maxsize=4)
def _program(known_axes: tuple[int, ...], size: int, driven: bool) -> Program[SmoothingState]:
    def function(w: SmoothingState) -> SmoothingState:
        return w._replace(after=smooth_epoch(w.incoming, w.after, known_axes))

    return Program(function, SmoothingState(blank_epoch(size, driven), track_end(size)))


def smooth(
    x: Array,
    P: Array,
    x_predicted: Array,
    P_predicted: Array,
    dt: Array,
    planar: bool = False,
    hz_per_mps: Number | None = None,
) -> tuple[Array, Array]:
    """Return smoothed means (N, T, 7 or 8) and packed covariances (N, T, 28 or 36) of tracks.

    Args:
        x: (N, T, 7 or 8) filtered means; the eighth component is the range bias.
        P: (N, T, 28 or 36) filtered covariances, packed.
        x_predicted, P_predicted: means and covariances predicted for each epoch before its update,
            with the shapes of ``x`` and ``P``.
        dt: (T - 1,) seconds from each epoch to the next; (N, T - 1) if they differ between tracks.
        planar: whether z and vz are known exactly.
        hz_per_mps: carrier frequency divided by the speed of light, if the oscillator drives a
            range bias; else None.
    """
    N, T, size = x.shape
    driven = size > STATE_SIZE and hz_per_mps is not None
    program = _program(VERTICAL if planar else (), size, driven)
    since = np.ones((N, T))
    since[:, 1:] = dt
    parts = [since[..., None], x, P, x_predicted, P_predicted]
    if driven:
        parts.append(np.full((N, T, 1), hz_per_mps))
    forwards = np.concatenate(parts, axis=2)
    rows = blocks_of(program.start, N)
    io = StepIO.of(N, T, output_rows=rows_of([program.index.after.x, program.index.after.P]))
    program.run_on_lanes(BatchState.of(np.ascontiguousarray(forwards[:, ::-1]), rows), io)
    smoothed = io.outputs[:, ::-1]
    return smoothed[..., :size].copy(), smoothed[..., size:].copy()
