"""Sensitivities of whitened innovations to errors of a log, and the errors that fit them.

The filter, without its safeguards, runs once for each parameter of an error with a small step of
it. The differences of the whitened innovations w are the sensitivities J; they include how the
track gives way. Robust least squares of w = J theta gives the error theta (Huber 1981, Robust
Statistics, Sec. 7). Blockages correlate innovations, so the covariance of theta is computed from
blocks of epochs (sandwich estimator, ibid. Sec. 7.6).
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import huber

from mmwave_env.engines.engine import tracker_of
from mmwave_env.filters.modes import Mode
from mmwave_env.localization.image_filter import difference, links_along
from mmwave_env.localization.readings import RANGE, Reading
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.models.measurement import doppler_group
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode

_HUBER = 2.0  # standard deviations
rho = partial(huber, _HUBER)  # function of whitened innovations: quadratic at 0, linear far away
_BLOCKS = (10, 20, 40)  # epochs in a block; the length with the largest variance counts
_ROUNDS = 8  # of robust least squares


class Fit(NamedTuple):
    """The result of robust least squares."""

    theta: Array  # (p,)
    sigma: Array  # (p,) standard deviations
    wald: float  # theta' V^-1 theta, with the covariance V of theta
    gain: float  # decrease of the sum of rho, but not more than the usual blocks of epochs show


def filtered(episodes: Sequence[Episode], mode: Mode, *names: str) -> Iterable[Array]:
    """Return parts of the state, by name, of tracks of a mode: arrays (N, epochs, values).

    The mode runs without safeguards, which would hide what is wrong with measurements.
    """
    bare = replace(
        mode, gate=None, recovery=None, adaptive=False, robust=False, blockage_aware=False
    )
    return tracker_of(bare, episodes).run(*names).values()


def innovations(readings: Sequence[Reading]) -> Array:
    """Return whitened innovations (n, T, rows) of n readings, 0 where nothing was measured.

    The covariance is always that of the first reading, so that innovations can be compared.

    Raises:
        ValueError: measurements are so wrong that a state becomes NaN or infinite.
    """
    episodes = [reading.with_start().episode for reading in readings]
    x, P = filtered(episodes, readings[0].mode, "x_predicted", "P_predicted")
    if not (np.isfinite(x).all() and np.isfinite(P[0]).all()):
        raise ValueError("log: found a track with NaN or infinity, expected plausible values")
    e, gradients = zip(*map(_expanded, episodes, x), strict=True)
    used = episodes[0].used
    H = gradients[0] * used[..., None]
    R = np.where(used, episodes[0].sigma ** 2, 1.0)[..., None] * np.eye(used.shape[1])
    S = H @ np.array(unpack(list(P[0].T))).T @ H.swapaxes(1, 2) + R
    columns = np.moveaxis(np.where(used, e, 0.0), 0, -1)
    return np.moveaxis(np.linalg.solve(np.linalg.cholesky(S), columns), -1, 0)


def _expanded(episode: Episode, x: Array) -> tuple[Array, Array]:
    """Return innovations z - h(x) (T, rows), and gradients dh/dx (T, rows, states).

    ``x`` (T, states) are the states in the epochs of the episode.
    """
    z = episode.measurement
    d = x[:, None, :3] - episode.scene_anchors_m
    h, slopes = links_along(d.reshape(-1, 3))
    h = h.reshape(*d.shape[:2], -1)
    h[..., 0] += x[:, STATE_SIZE:].sum(axis=1, keepdims=True)
    links = difference(z[:, :-1].reshape(h.shape), h).reshape(len(x), -1)
    anchor = 0 if episode.doppler_anchor is None else episode.doppler_anchor
    place = list(episode.scene_anchors_m[anchor].T)
    doppler = doppler_group(list(x.T), place, episode.hz_per_mps, [z[:, -1]], [1.0])
    H = np.zeros((*z.shape, x.shape[1]))
    H[:, :-1, :3] = slopes.reshape(len(x), -1, 3)
    H[:, RANGE, STATE_SIZE:] = 1.0
    H[:, -1] = np.stack(np.broadcast_arrays(*doppler.jacobian[0]), axis=1)
    return np.column_stack([links, *doppler.innovation]), H


def fit(w: Array, J: Array, deviation: float) -> Fit:
    """Fit whitened innovations (T, rows) by J theta, with sensitivities J (T, rows, p).

    The prior standard deviation of every parameter is ``deviation``.
    """
    T, _, p = J.shape
    gradients = np.moveaxis(J, -1, 0)
    ridge = np.eye(p) / deviation**2
    theta: Array = np.zeros(p)
    for _ in range(_ROUNDS):
        weighted = gradients * (_HUBER / np.maximum(abs(w - J @ theta), _HUBER))
        information = np.tensordot(weighted, J) + ridge
        theta = np.linalg.solve(information, np.tensordot(weighted, w)).astype(float)
    r = w - J @ theta
    decrease = (rho(w) - rho(r)).sum(axis=1)
    blocks = np.add.reduceat(decrease, np.arange(0, T, _BLOCKS[0]))
    usual = np.sort(blocks)[: -max(len(blocks) // 10, 1)]
    scores = (gradients * np.clip(r, -_HUBER, _HUBER)).sum(axis=2).T
    inside = gradients * (abs(r) < _HUBER)
    inverse = np.linalg.inv(np.tensordot(inside, J) + ridge).astype(float)
    V = inverse * max(1.0, *(_growth(scores, inverse, length) for length in _BLOCKS))
    wald = float(theta @ np.linalg.solve(V, theta))
    gain = float(min(blocks.sum(), 2.0 * usual.sum()))
    return Fit(theta, np.sqrt(np.diag(V)), wald, gain)


def _growth(scores: Array, inverse: Array, length: int) -> float:
    """Return by which factor blocks of epochs show a covariance larger than ``inverse`` (p, p).

    ``scores`` (T, p) are the epochs' derivatives of the sum of rho; ``length`` is in epochs.
    """
    T, p = scores.shape
    n = max(T // length, 4)
    sums = np.add.reduceat(scores, -(-np.arange(n) * T // n))
    covariance: Array = n * np.cov(sums.T).reshape(p, p)
    factor: float = np.trace(inverse @ covariance).item() / p
    return factor
