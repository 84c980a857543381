"""Features of smoothed tracks, for a network that corrects them.

The features are the same that correctors read after every update
(:func:`mmwave_env.interface.signed.after_update`). However, belief, residuals and the direction of
motion come from the smoothed track; only gates and modes' probabilities come from the filter.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mmwave_env.engines.epoch import with_expected_spread
from mmwave_env.filters.imm import begin
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.features import View
from mmwave_env.interface.observation import standardized
from mmwave_env.interface.signed import LastEpoch, after_update
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array, Array32
from mmwave_env.numerics.pytree import indices, unflatten
from mmwave_env.world.episode import EpisodeBatch, blank_incoming

GATES = ("nis", "accepted", "rejected")  # fields of a memory that the features read


def smoothed_features(
    pipeline: Pipeline,
    batch: EpisodeBatch,
    x: Array,
    P: Array,
    mixtures: Array,
    gates: Sequence[Array],
) -> Array32:
    """Return the standardized features (N, T, features) of N smoothed tracks of T epochs.

    Args:
        pipeline: pipeline of the modes.
        batch: the N episodes or parts of episodes that were filtered.
        x, P: (N, T, 7) means and (N, T, 28) packed covariances of the smoothed beliefs.
        mixtures: (N, T, numbers) the filter's :class:`~mmwave_env.filters.imm.Mixture` after each
            epoch, flattened.
        gates: for each name in :data:`GATES`, values (N, T, groups) from the most probable mode.
    """
    layout = pipeline.layout
    n = x.shape[-1]
    epoch = unflatten(blank_incoming(layout), iter(_leaves(batch.table))).epoch(layout)
    site = unflatten(blank_site(layout), iter(_leaves(batch.site[:, None])))
    at = indices(begin(pipeline, [0.0] * n, [0.0] * layout.triangle))
    probabilities = _leaves(mixtures[..., np.array(at.probability)])
    kept: Any = {name: _leaves(gate) for name, gate in zip(GATES, gates, strict=True)}
    memory = initial_memory(layout, len(pipeline.modes))._replace(**kept)
    before = _leaves(np.concatenate([x[:, :1], x[:, :-1]], axis=1))[3:6]
    last = LastEpoch(with_expected_spread(epoch, before, site), 0.0, before, probabilities)
    covariance = unpack(_leaves(P), zero=pipeline.known_axes)
    view = View(_leaves(x), covariance, memory, [], epoch, site, None, last)
    with np.errstate(all="ignore"):  # values of missing rows are not used
        values = standardized(after_update(pipeline, per_mode=True), view)
    return np.stack(np.broadcast_arrays(*values), axis=-1).astype(np.float32)


def _leaves(rows: Array) -> list[Array]:
    """Return the parts of arrays (..., k) along the last axis."""
    return list(np.moveaxis(rows, -1, 0))
