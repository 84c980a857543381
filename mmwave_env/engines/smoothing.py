"""Finished tracks smoothed, many at once (paper, Sec. III-F)."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, rows_of
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.filters.smoother import (
    BackwardState,
    ForwardEpoch,
    blank_epoch,
    smooth_epoch,
    track_end,
)
from mmwave_env.models.measurement import STATE_SIZE
from mmwave_env.numerics.arrays import Array


class SmoothingState(NamedTuple):
    """The smoother between two epochs, going backwards."""

    incoming: ForwardEpoch  # the epoch at hand
    after: BackwardState  # what the epoch after it left


@lru_cache(maxsize=2)
def _program(known_axes: tuple[int, ...]) -> Program[SmoothingState]:
    def function(w: SmoothingState) -> SmoothingState:
        return w._replace(after=smooth_epoch(w.incoming, w.after, known_axes))

    return Program(function, SmoothingState(blank_epoch(), track_end(with_covariance=True)))


def smooth(
    x: Array, P: Array, x_predicted: Array, P_predicted: Array, dt: Array, planar: bool = False
) -> tuple[Array, Array]:
    """Smoothed means (N, T, 7) and packed covariances (N, T, 28) of finished tracks.

    Args:
        x: (N, T, 7) filtered means.
        P: (N, T, 28) filtered covariances, packed.
        x_predicted, P_predicted: (N, T, 7), (N, T, 28) beliefs predicted for each epoch, before its
            update.
        dt: (T - 1,) seconds from each epoch to the next, or (N, T - 1) of every track's own.
        planar: z and vz are known exactly.
    """
    program = _program(VERTICAL if planar else ())
    N, T, _ = x.shape
    since = np.ones((N, T))
    since[:, 1:] = dt
    forwards = np.concatenate([since[..., None], x, P, x_predicted, P_predicted], axis=2)
    rows = blocks_of(program.start, N)
    io = StepIO.of(N, T, output_rows=rows_of([program.index.after.x, program.index.after.P]))
    backwards = np.ascontiguousarray(forwards[:, ::-1])
    program.run_on_lanes(BatchState.of(backwards, rows), io)
    smoothed = io.outputs[:, ::-1]
    return smoothed[..., :STATE_SIZE].copy(), smoothed[..., STATE_SIZE:].copy()
