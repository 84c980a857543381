"""Smoothing of tracks, backwards in time (paper, Sec. III-F).

A network that corrects smoothed tracks reads the same features that correctors read after every
update (:func:`mmwave_env.interface.signed.after_update`). However, belief, residuals and the
direction of motion come from the smoothed track; only gates and modes' probabilities come from the
filter.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, fill, rows_of
from mmwave_env.engines.epoch import with_expected_spread
from mmwave_env.filters.imm import mixture_index
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.smoother import TrackEpoch, blank_epoch, smooth_epoch
from mmwave_env.interface.features import View
from mmwave_env.interface.observation import standardized
from mmwave_env.interface.signed import LastEpoch, after_update
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array, Array32
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import blank_incoming

SMOOTHED = "x P x_predicted P_predicted"  # the filtered belief, and the belief before the update


class SmoothingState(NamedTuple):
    """The state of the smoother between two epochs of the backward pass."""

    incoming: TrackEpoch  # the current epoch
    after: TrackEpoch  # the following epoch, smoothed


@lru_cache(maxsize=4)
def _program(known_axes: tuple[int, ...], size: int, driven: bool) -> Program[SmoothingState]:
    def function(w: SmoothingState) -> SmoothingState:
        return w._replace(after=smooth_epoch(w.incoming, w.after, known_axes))

    blank = blank_epoch(size, driven)
    return Program(function, SmoothingState(blank, blank))


def smooth(pipeline: Pipeline, tracks: Array, dt: Array, hz_per_mps: float) -> tuple[Array, Array]:
    """Return smoothed means (N, T, 7 or 8) and packed covariances (N, T, 28 or 36) of tracks.

    Args:
        pipeline: pipeline of the modes, which share a belief.
        tracks: (N, T, numbers) the part :data:`SMOOTHED` of the filter's state after each epoch.
        dt: (N, T) seconds since the previous epoch; the first are not used.
        hz_per_mps: carrier frequency divided by the speed of light.
    """
    N, T, _ = tracks.shape
    layout = pipeline.layout
    size = layout.state_size
    driven = layout.clock == "offset"
    program = _program(pipeline.known_axes, size, driven)
    drive = np.full((N, T, int(driven)), hz_per_mps)
    backwards = np.concatenate([dt[..., None], tracks, drive], axis=2)[:, ::-1]
    at = program.index.after
    rows = fill(blocks_of(program.start, N), rows_of(at), backwards[:, 0])
    io = StepIO.of(N, T - 1, output_rows=rows_of([at.x, at.P]))
    program.run_on_lanes(BatchState.of(np.ascontiguousarray(backwards[:, 1:]), rows), io)
    last = tracks[:, -1:, : size + layout.triangle]
    smoothed = np.concatenate([io.outputs[:, ::-1], last], axis=1)
    return smoothed[..., :size].copy(), smoothed[..., size:].copy()


GATES = ("nis", "accepted", "rejected")  # fields of a memory that the features read


def smoothed_features(
    pipeline: Pipeline,
    table: Array,
    sites: Array,
    x: Array,
    P: Array,
    mixtures: Array,
    gates: Sequence[Array],
) -> Array32:
    """Return the standardized features (N, T, features) of N smoothed tracks of T epochs.

    Args:
        pipeline: pipeline of the modes.
        table: (N, T, columns) epochs, as in :meth:`~mmwave_env.world.episode.Episode.table`.
        sites: (N, numbers) anchors, carriers and priors; (1, numbers) if all tracks share them.
        x, P: (N, T, 7) means and (N, T, 28) packed covariances of the smoothed beliefs.
        mixtures: (N, T, numbers) the filter's :class:`~mmwave_env.filters.imm.Mixture` after each
            epoch, flattened.
        gates: for each name in :data:`GATES`, values (N, T, groups) from the most probable mode.
    """
    layout = pipeline.layout
    epoch = unflatten(blank_incoming(layout), iter(_leaves(table))).epoch(layout)
    site = unflatten(blank_site(layout), iter(_leaves(sites[:, None])))
    probabilities = _leaves(mixtures[..., np.array(mixture_index(pipeline).probability)])
    kept: Any = {name: _leaves(gate) for name, gate in zip(GATES, gates, strict=True)}
    memory = initial_memory(layout, len(pipeline.modes))._replace(**kept)
    before = _leaves(np.concatenate([x[:, :1], x[:, :-1]], axis=1))[3:6]
    last = LastEpoch(with_expected_spread(epoch, before, site), 0.0, before, probabilities)
    covariance = unpack(_leaves(P), zero=pipeline.known_axes)
    view = View(_leaves(x), covariance, memory, [], epoch, site, layout, last=last)
    with np.errstate(all="ignore"):  # values of missing rows are not used
        values = standardized(after_update(pipeline), view)
    return np.stack(np.broadcast_arrays(*values), axis=-1).astype(np.float32)


def _leaves(rows: Array) -> list[Array]:
    """Return the parts of arrays (..., k) along the last axis."""
    return list(np.moveaxis(rows, -1, 0))
