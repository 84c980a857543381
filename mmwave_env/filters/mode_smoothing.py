"""Fixed-interval smoothing of interacting modes, backwards over a finished track of an IMM.

If one of the modes has little process noise, a Rauch-Tung-Striebel smoother that treats the
mixture as one Gaussian is overconfident. Here every mode has its own smoothed belief. Each backward
step computes a smoothed belief for each pair (mode j in this epoch, mode i in the following one)
with the motion model of mode i. Then it merges the beliefs with the same j. A pair's weight is the
probability of i given all measurements, times the probability of j given i. The second factor
depends on how well mode i, starting from the belief of j, predicts the smoothed state of i.

Sources: for the pairs, Kim 1994, "Dynamic linear models with Markov-switching"; for their weights,
Barber 2006, "Expectation correction for smoothed inference in switching linear dynamical systems",
JMLR 7. With one mode, the result is the same as in :func:`mmwave_env.filters.textbook.rts`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.imm import begin, over_step
from mmwave_env.filters.pipeline import Pipeline, predict
from mmwave_env.models.measurement import Epoch
from mmwave_env.models.motion import transition_times
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array
from mmwave_env.numerics.pytree import indices


class ModeBeliefs(NamedTuple):
    """Beliefs of all modes of N tracks, after one epoch or after every epoch.

    Attributes:
        x: (N, ..., modes, 7) means; with the range bias of a clock, 8 numbers instead of 7.
        P: (N, ..., modes, 7, 7) covariances.
        probability: (N, ..., modes) probabilities of the modes.
    """

    x: Array
    P: Array
    probability: Array


def merged(beliefs: ModeBeliefs) -> tuple[Array, Array]:
    """Return the means (..., 7) and the covariances (..., 7, 7) of mixtures of all modes."""
    weight = beliefs.probability[..., None]
    mean = (weight * beliefs.x).sum(axis=-2)
    offset = beliefs.x - mean[..., None, :]
    outer = offset[..., :, None] * offset[..., None, :]
    return mean, (weight[..., None] * (beliefs.P + outer)).sum(axis=-3)


def smooth_modes(
    bank: Bank,
    pipeline: Pipeline,
    mixtures: Array,
    dt: Array,
    spread_hz: Array,
    hz_per_mps: float,
) -> tuple[Array, Array]:
    """Return smoothed means (N, T, 7 or 8) and packed covariances (N, T, 28 or 36) of tracks.

    Args:
        bank: modes, with their tunings, and transition probabilities.
        pipeline: pipeline of the bank's modes.
        mixtures: (N, T, numbers) the IMM's :class:`~mmwave_env.filters.imm.Mixture` after each
            epoch, flattened.
        dt: (N, T) seconds since the previous epoch.
        spread_hz: (N, T) measured Doppler spread.
        hz_per_mps: carrier frequency divided by the speed of light.
    """
    transition = settings_of(bank, pipeline.layout).transition
    filtered, gamma = _beliefs(mixtures, pipeline)
    after = ModeBeliefs(*(part[:, -1] for part in filtered))
    smoothed = [merged(after)]
    for t in range(dt.shape[1] - 2, -1, -1):
        now = ModeBeliefs(*(part[:, t] for part in filtered))
        coming = Epoch(dt[:, t + 1, None], [], [], [], [], spread_hz[:, t + 1, None])
        moves = over_step(transition, dt[:, t + 1, None, None])
        matrix = np.concatenate([np.concatenate(row, axis=2) for row in moves], axis=1)
        after = _backwards(pipeline, now, gamma[:, t], after, coming, hz_per_mps, matrix)
        smoothed.append(merged(after))
    means, covariances = zip(*reversed(smoothed), strict=True)
    P = np.stack(covariances, axis=1)
    return np.stack(means, axis=1), P[..., *np.tril_indices(P.shape[-1])]


def _beliefs(mixtures: Array, pipeline: Pipeline) -> tuple[ModeBeliefs, Array]:
    """Return the modes' beliefs, and gamma (N, T, modes), the scale of Q in adaptive modes."""
    n = pipeline.layout.state_size
    triangle = pipeline.layout.triangle
    at = indices(begin(pipeline, [0.0] * n, [0.0] * triangle))
    packed = mixtures[..., np.array([track.P for track in at.tracks])]
    P = np.empty((*packed.shape[:-1], n, n))
    row, column = np.tril_indices(n)
    P[..., row, column] = P[..., column, row] = packed
    x = mixtures[..., np.array([track.x for track in at.tracks])]
    gamma = mixtures[..., np.array([track.memory.gamma for track in at.tracks])]
    return ModeBeliefs(x, P, mixtures[..., np.array(at.probability)]), gamma


def _backwards(
    pipeline: Pipeline,
    now: ModeBeliefs,
    gamma: Array,
    after: ModeBeliefs,
    coming: Epoch,
    hz_per_mps: float,
    transition: Array,
) -> ModeBeliefs:
    """Return the smoothed beliefs of an epoch, given the smoothed beliefs of the following epoch.

    Args:
        pipeline: pipeline of the modes.
        now, gamma: filtered beliefs of the epoch, and the scale (N, modes) of Q in adaptive modes.
        after: smoothed beliefs of the following epoch.
        coming: the following epoch; only its dt and Doppler spread, both (N, 1), are used.
        hz_per_mps: carrier frequency divided by the speed of light.
        transition: (N, modes, modes) probabilities [track, mode now, mode in the following epoch].
    """
    known = list(pipeline.known_axes)
    n = now.x.shape[-1]
    x_now = [now.x[..., i] for i in range(n)]  # each an array (N, modes now)
    packed = [now.P[..., i, j] for i in range(n) for j in range(i + 1)]
    FP = _matrix(transition_times(unpack(packed), coming.dt, hz_per_mps), now.x.shape[:-1])
    x = []
    P = []
    weight = []
    for i, mode in enumerate(pipeline.modes):
        mean, covariance = predict(
            pipeline, mode, x_now, packed, gamma[:, i, None], coming, hz_per_mps
        )
        x_predicted = np.stack(np.broadcast_arrays(*mean), axis=-1)
        P_predicted = _matrix(covariance, now.x.shape[:-1])
        P_predicted[..., known, known] = 1.0  # instead of 0, so that the matrix has an inverse
        step = after.x[:, i, None] - x_predicted
        solved = np.linalg.solve(P_predicted, np.concatenate([FP, step[..., None]], axis=-1))
        gain = np.swapaxes(solved[..., :-1], -1, -2)  # 0 for known axes
        change = after.P[:, i, None] - P_predicted
        x.append(now.x + (gain @ step[..., None])[..., 0])
        P.append(now.P + gain @ change @ np.swapaxes(gain, -1, -2))
        distance = (step * solved[..., -1]).sum(axis=-1)
        density = -0.5 * (distance + np.linalg.slogdet(P_predicted)[1])
        weight.append(np.log(transition[:, :, i] * now.probability) + density)
    logs = np.stack(weight, axis=2)  # indexed like ``transition``
    joint = np.exp(logs - logs.max(axis=1, keepdims=True))
    joint *= after.probability[:, None] / joint.sum(axis=1, keepdims=True)
    probability = np.maximum(joint.sum(axis=2), np.finfo(float).tiny)
    pairs = ModeBeliefs(np.stack(x, axis=2), np.stack(P, axis=2), joint / probability[..., None])
    return ModeBeliefs(*merged(pairs), probability / probability.sum(axis=1, keepdims=True))


def _matrix(entries: Sequence[Sequence[Array]], shape: tuple[int, ...]) -> Array:
    """Stack a matrix of arrays into one array (..., 7, 7)."""
    rows = [np.stack([np.broadcast_to(e, shape) for e in row], axis=-1) for row in entries]
    return np.stack(rows, axis=-2)
