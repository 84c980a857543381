"""Replays of finished episodes, and the smoothing of tracks.

An environment does not store its track. To smooth the track, the finished episode is run again with
the modes that were chosen; then the track is smoothed backwards (paper, Sec. III-F).
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, fill, rows_of
from mmwave_env.engines.imm_engine import imm_program
from mmwave_env.engines.track_engine import program_of
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.pipeline import VERTICAL, Pipeline
from mmwave_env.filters.smoother import (
    BackwardState,
    ForwardEpoch,
    blank_epoch,
    smooth_epoch,
    track_end,
)
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.numerics.numbers import Array
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import EpisodeBatch

Actions = NDArray[np.integer[Any]]

_KEPT = ("x", "P", "x_predicted", "P_predicted", "incoming.dt", "site.hz_per_mps", "error", "nees")


class Replay:
    """A replay of finished episodes of a pipeline.

    Args:
        pipeline: modes and layout.
        bank: modes and transition probabilities, if every mode keeps its own belief; else None.
    """

    def __init__(self, pipeline: Pipeline, bank: Bank | None = None) -> None:
        self._program: Program[Any]
        if bank:
            self._program = imm_program(pipeline, TrackingReward(), acted=True)
            tuned: Any = self._program.index.settings
            numbers = flatten(settings_of(bank, pipeline.layout))
        else:
            self._program = program_of(pipeline)
            tuned = self._program.index.tunings
            numbers = flatten([mode.tuning for mode in pipeline.modes])
        self._start = self._program.start.copy()
        self._planar = pipeline.planar
        self._start[rows_of(tuned)] = numbers

    def run(self, episodes: EpisodeBatch, actions: Actions) -> tuple[Array, ...]:
        """Run finished episodes again, and smooth them.

        The results for an episode do not depend on the other episodes, not even by rounding.

        Args:
            episodes: n episodes.
            actions: (n, T) modes chosen in the first T epochs of each episode.

        Returns:
            Position errors (n, T, 3), m, and NEES (n, T) of the filtered tracks; position errors
            (n, T, 3) of the smoothed tracks.
        """
        program = self._program
        index = self._program.index
        (n, T) = actions.shape
        io = StepIO.of(n, T, rows_of(index.action), program.rows(_KEPT))
        io.inputs[..., 0] = actions
        rows = fill(blocks_of(self._start, n), rows_of(index.site), episodes.site)
        program.run_on_lanes(BatchState.of(episodes.table, rows), io)
        parts = program.by_name(_KEPT, io.outputs).values()
        x, P, x_predicted, P_predicted, dt, hz_per_mps, error, nees = parts
        known = x_predicted, P_predicted, dt[:, 1:], self._planar, float(hz_per_mps[0, 0])
        smoothed, _ = smooth(x, P, *known)
        return error, nees, error + (smoothed - x)[..., :3]


class SmoothingState(NamedTuple):
    """The state of the smoother between two epochs of the backward pass."""

    incoming: ForwardEpoch  # the current epoch
    after: BackwardState  # the following epoch, smoothed


@lru_cache(maxsize=4)
def _program(known_axes: tuple[int, ...], size: int) -> Program[SmoothingState]:
    def function(w: SmoothingState) -> SmoothingState:
        return w._replace(after=smooth_epoch(w.incoming, w.after, known_axes))

    return Program(function, SmoothingState(blank_epoch(size), track_end(size)))


def smooth(
    x: Array,
    P: Array,
    x_predicted: Array,
    P_predicted: Array,
    dt: Array,
    planar: bool = False,
    hz_per_mps: float = np.nan,
) -> tuple[Array, Array]:
    """Return smoothed means (N, T, 7 or 8) and packed covariances (N, T, 28 or 36) of tracks.

    Args:
        x: (N, T, 7 or 8) filtered means; the eighth component is the range bias.
        P: (N, T, 28 or 36) filtered covariances, packed.
        x_predicted, P_predicted: means and covariances predicted for each epoch before its update,
            with the shapes of ``x`` and ``P``.
        dt: (T - 1,) seconds from each epoch to the next; (N, T - 1) if they differ between tracks.
        planar: whether z and vz are known exactly.
        hz_per_mps: carrier frequency divided by the speed of light; needed only with a range bias.
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
