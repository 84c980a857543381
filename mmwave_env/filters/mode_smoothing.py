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

from typing import Any, NamedTuple, TypeVar

import numpy as np

from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.imm import mixture_index, over_step
from mmwave_env.filters.pipeline import Pipeline, predict
from mmwave_env.filters.textbook import combine
from mmwave_env.models.measurement import Epoch
from mmwave_env.models.motion import move
from mmwave_env.numerics.linalg import cholesky, forward, pack, unpack
from mmwave_env.numerics.numbers import Array

_EPOCHS_TOGETHER = 800  # number of epochs whose predictions are computed together
Parts = TypeVar("Parts", bound=tuple[Array, ...])


class ModeBeliefs(NamedTuple):
    """Beliefs of all modes of N tracks, after one epoch or after every epoch.

    Attributes:
        probability: (N, ..., modes) probabilities of the modes.
        x: (N, ..., modes, 7) means; with the range bias of a clock, 8 numbers instead of 7.
        P: (N, ..., modes, 7, 7) covariances.
    """

    probability: Array
    x: Array
    P: Array


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
    together = max(1, _EPOCHS_TOGETHER // dt.shape[1])
    if len(dt) > together:
        groups = [slice(first, first + together) for first in range(0, len(dt), together)]
        parts = [
            smooth_modes(bank, pipeline, mixtures[g], dt[g], spread_hz[g], hz_per_mps)
            for g in groups
        ]
        means, covariances = zip(*parts, strict=True)
        return np.concatenate(means), np.concatenate(covariances)
    at = mixture_index(pipeline)
    filtered = ModeBeliefs(
        mixtures[..., np.array(at.probability)],
        mixtures[..., np.array(at.x)],
        np.take(mixtures, list(map(unpack, at.P)), axis=-1),
    )
    gamma = mixtures[..., np.array([memory.gamma for memory in at.memories])]
    transition = settings_of(bank).transition
    coming = Epoch(dt[:, 1:, None], [], [], [], [], spread_hz[:, 1:, None])
    before = _epochs(filtered, slice(-1))
    moves = _predicted(pipeline, before, gamma[:, :-1], coming, hz_per_mps, transition)
    after = _epochs(filtered, -1)
    smoothed = [combine(*after)]
    for t in reversed(range(dt.shape[1] - 1)):
        after = _backwards(_epochs(filtered, t), _epochs(moves, t), after)
        smoothed.append(combine(*after))
    means, covariances = zip(*reversed(smoothed), strict=True)
    P = np.stack(covariances, axis=1)
    return np.stack(means, axis=1), P[..., *np.tril_indices(P.shape[-1])]


def _epochs(parts: Parts, epochs: int | slice) -> Parts:
    """Return some epochs, or a single one, of a tuple of arrays (N, T, ...)."""
    return type(parts)(*(part[:, epochs] for part in parts))


class _Moves(NamedTuple):
    """Predictions of a following epoch, for each mode now and each mode in that epoch.

    Attributes:
        x: (N, ..., modes now, modes, 7) predicted means.
        whitener: (N, ..., modes now, modes, 7, 7) inverses of the Cholesky factors of the predicted
            covariances P.
        gain: (N, ..., modes now, modes, 7, 7) smoother gains.
        rest: (N, ..., modes now, modes, 7, 7) covariances now, if the following state were known.
        log_weight: (N, ..., modes now, modes) logarithms of joint probabilities of both modes,
            given the measurements until now, divided by the square roots of det P.
    """

    x: Array
    whitener: Array
    gain: Array
    rest: Array
    log_weight: Array


def _predicted(
    pipeline: Pipeline,
    now: ModeBeliefs,
    gamma: Array,
    coming: Epoch,
    hz_per_mps: float,
    transition: Any,
) -> _Moves:
    """Return the predictions from filtered beliefs (N, T, modes), each for its following epoch.

    Args:
        pipeline: pipeline of the modes.
        now, gamma: filtered beliefs of epochs, and the scale (N, T, modes) of Q in adaptive modes.
        coming: the following epochs; only their dt and Doppler spread, both (N, T, 1), are used.
        hz_per_mps: carrier frequency divided by the speed of light.
        transition: probabilities of transitions in a second.
    """
    shape = now.probability.shape
    n = now.x.shape[-1]
    x_now = list(np.moveaxis(now.x, -1, 0))
    entries: Any = np.moveaxis(now.P, (-2, -1), (0, 1))
    P_now = pack(entries)
    rows = list(np.moveaxis(now.P, -2, 0))
    drive = pipeline.layout.bias_drive(hz_per_mps)
    FP = np.stack(np.broadcast_arrays(*move(rows, coming.dt[..., None], drive)), axis=-2)
    pairs = (*shape, shape[-1])
    x = np.empty((*pairs, n))
    whitener = np.zeros((*pairs, n, n))
    log_scale = np.empty(pairs)  # logarithms of square roots of det P
    for i, mode in enumerate(pipeline.modes):
        mean, P = predict(pipeline, mode, x_now, P_now, gamma[..., i, None], coming, hz_per_mps)
        covariance = [list(row) for row in P]
        for axis in pipeline.known_axes:  # 1 instead of 0, so that the matrix has an inverse
            covariance[axis][axis] = np.ones(shape)
        factor = cholesky(covariance)
        log_scale[..., i] = sum(np.log(factor[k][k]) for k in range(n))
        x[..., i, :] = np.stack(np.broadcast_arrays(*mean), axis=-1)
        for j in range(n):
            below = [row[j:] for row in factor[j:]]
            for k, value in enumerate(forward(below, [1.0] + [0.0] * (n - j - 1)), start=j):
                whitener[..., i, k, j] = value
    whitened = whitener @ FP[..., None, :, :]
    gain = np.swapaxes(whitened, -1, -2) @ whitener  # 0 for known axes
    rest = now.P[..., None, :, :] - np.swapaxes(whitened, -1, -2) @ whitened
    matrix = np.block(over_step(transition, coming.dt[..., None]))  # type: ignore[var-annotated]
    log_weight = np.log(matrix * now.probability[..., None]) - log_scale
    return _Moves(x, whitener, gain, rest, log_weight)


def _backwards(now: ModeBeliefs, move: _Moves, after: ModeBeliefs) -> ModeBeliefs:
    """Return the smoothed beliefs of an epoch, given the smoothed beliefs of the following epoch.

    Args:
        now: filtered beliefs of the epoch.
        move: predictions of the following epoch.
        after: smoothed beliefs of the following epoch.
    """
    step = after.x[:, None] - move.x
    distance = np.square((move.whitener @ step[..., None])[..., 0]).sum(axis=-1)
    logs = move.log_weight - 0.5 * distance
    joint = np.exp(logs - logs.max(axis=1, keepdims=True))
    joint *= after.probability[:, None] / joint.sum(axis=1, keepdims=True)
    probability = np.maximum(joint.sum(axis=2), np.finfo(float).tiny)
    x = now.x[:, :, None] + (move.gain @ step[..., None])[..., 0]
    P = move.rest + move.gain @ after.P[:, None] @ np.swapaxes(move.gain, -1, -2)
    total = probability.sum(axis=1, keepdims=True)
    return ModeBeliefs(probability / total, *combine(joint / probability[..., None], x, P))
