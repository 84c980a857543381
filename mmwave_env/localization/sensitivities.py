"""Sensitivities of whitened innovations to errors of a log, and the errors that fit them.

The filter, without its safeguards, runs once for each parameter of an error with a small step of
it. The differences of the whitened innovations w are the sensitivities J; they include how the
track gives way. Robust least squares of w = J theta gives the error theta (Huber 1981, Robust
Statistics, Sec. 7). Blockages correlate innovations, so the covariance of theta is computed from
blocks of epochs (sandwich estimator, ibid. Sec. 7.6).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mmwave_env.engines.engine import tracks_of
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.localization.localizer import episode_from
from mmwave_env.localization.readings import RANGE, Reading
from mmwave_env.localization.starts import Start, gives_fix, start_at
from mmwave_env.models.layout import wrapped
from mmwave_env.models.measurement import Group, doppler_group, exact_rows, link_group
from mmwave_env.numerics.numbers import Array, Vector
from mmwave_env.world.episode import Episode

_HUBER = 2.0  # standard deviations
_BLOCKS = (10, 20, 40)  # epochs in a block; the length with the largest variance counts
_ROUNDS = 8  # of robust least squares


class Fit(NamedTuple):
    """The result of robust least squares."""

    theta: Array  # (p,)
    sigma: Array  # (p,) standard deviations
    wald: float  # theta' V^-1 theta, with the covariance V of theta
    gain: float  # decrease of the sum of rho, but not more than the usual blocks of epochs show


class FilterRun(NamedTuple):
    """A mode and a start with which to run the filter on readings of a log."""

    mode: Mode  # without safeguards
    start: Start | None  # None if every reading begins with a start from its own first link

    @classmethod
    def of(cls, mode: Mode, first: Reading, start: Start) -> "FilterRun":
        """Return how to run a mode on readings like the first, which has this start.

        A complete link of the base station gives each reading a start of its own. Other starts take
        long to compute, and a track forgets them soon.
        """
        link = first.log.measurement[:1, :4]
        whole = bool(np.isfinite(link).all()) and bool(gives_fix(link)[0])
        alone = len(start.spent) == 1 and start.spent[0].sum() == 1 and start.spent[0, 0]
        return cls(bare(mode), None if whole and alone and not first.log.layout.has_bias else start)

    def episode(self, reading: Reading) -> Episode:
        """Return a reading as an episode that begins with its first epoch."""
        log, scene, radio, *_ = reading.wrapped()
        return episode_from(log, scene, radio, self.start or start_at(log, 0, scene, radio))


def bare(mode: Mode) -> Mode:
    """Return a mode without safeguards, which would hide what is wrong with measurements."""
    return replace(
        mode, gate=None, recovery=None, adaptive=False, robust=False, blockage_aware=False
    )


def innovations(readings: Sequence[Reading], run: FilterRun) -> Array:
    """Return whitened innovations (n, T, rows) of n readings, 0 where nothing was measured.

    The covariance is always that of the first reading, so that innovations can be compared.

    Raises:
        ValueError: measurements are so wrong that a state becomes NaN or infinite.
    """
    episodes = [run.episode(reading) for reading in readings]
    tracker = tracks_of(Pipeline((run.mode,), episodes[0].layout), len(episodes))
    tracker.load(episodes)
    x, P = tracker.run("x_predicted", "P_predicted").values()
    if not (np.isfinite(x).all() and np.isfinite(P[0]).all()):
        raise ValueError("log: found a track with NaN or infinity, expected plausible values")
    states = np.moveaxis(x, 2, 1)
    e = np.stack([_innovation(*pair) for pair in zip(episodes, states, strict=True)])
    S = _covariance(episodes[0], states[0], P[0])
    columns = np.moveaxis(np.where(episodes[0].used, e, 0.0), 0, -1)
    white = np.linalg.solve(np.linalg.cholesky(S), columns)
    return np.moveaxis(white, -1, 0)


def _innovation(episode: Episode, x: Array) -> Array:
    """Return the innovations z - h(x) (T, rows) at states x (7 or 8, T)."""
    z = episode.measurement.T
    layout = episode.layout
    state = list(x)
    anchors = episode.scene_anchors_m.tolist()
    h = exact_rows(state[:3], state[3:6], anchors, episode.hz_per_mps, layout)
    e: Array = z - np.stack(h)
    e[layout.angles] = wrapped(e[layout.angles])
    e[RANGE] -= x[7:].sum(axis=0)
    e[-1] = _doppler(episode, x).innovation[0]
    return e.T


def _doppler(episode: Episode, x: Array) -> Group:
    """Return the group of the Doppler shift, from the anchors that have it."""
    of = 0 if episode.doppler_anchor is None else episode.doppler_anchor
    anchor = list(episode.scene_anchors_m[of].T)
    shift = [episode.measurement[:, -1]]
    return doppler_group(list(x), anchor, episode.hz_per_mps, shift, [1.0])


def _covariance(episode: Episode, x: Array, P: Array) -> Array:
    """Return the covariances S = H P H' + R (T, rows, rows) at states x (7 or 8, T).

    ``P`` (T, 28 or 36) are packed covariances. A row that was not measured has variance 1.
    """
    n, T = x.shape
    unused = [0.0] * 4
    rows: list[Vector] = []
    for anchor in episode.scene_anchors_m.tolist():
        link = link_group(list(x), anchor, unused, [1.0] * 4).jacobian
        rows += [*link, link[1]]  # both azimuths have the same gradient
    rows += _doppler(episode, x).jacobian
    H = np.stack([[np.broadcast_to(d, T) for d in row] for row in rows]).transpose(2, 0, 1)
    H = H * episode.used[..., None]
    full = np.zeros((T, n, n))
    i, j = np.tril_indices(n)
    full[:, i, j] = P
    full[:, j, i] = P
    R = np.where(episode.used, episode.sigma**2, 1.0)
    S: Array = H @ full @ H.transpose(0, 2, 1) + R[..., None] * np.eye(R.shape[1])
    return S


def rho(w: Array) -> Array:
    """Return Huber's function of whitened innovations: quadratic at 0, linear far away."""
    size = abs(w)
    return np.where(size <= _HUBER, 0.5 * w * w, _HUBER * size - 0.5 * _HUBER**2)


def fit(w: Array, J: Array, deviation: float) -> Fit:
    """Fit whitened innovations (T, rows) by J theta, with sensitivities J (T, rows, p).

    The prior standard deviation of every parameter is ``deviation``.
    """
    T, _, p = J.shape
    j = J.reshape(-1, p)
    y = w.reshape(-1)
    ridge = np.eye(p) / deviation**2
    theta: Array = np.zeros(p)
    for _ in range(_ROUNDS):
        size = np.maximum(abs(y - j @ theta), _HUBER)
        weighted = j * (_HUBER / size)[:, None]
        theta = np.linalg.solve(weighted.T @ j + ridge, weighted.T @ y).astype(float)
    r = y - j @ theta
    decrease = (rho(y) - rho(r)).reshape(T, -1).sum(axis=1)
    blocks = np.add.reduceat(decrease, np.arange(0, T, _BLOCKS[0]))
    usual = np.sort(blocks)[: len(blocks) - max(len(blocks) // 10, 1)]
    scores = (j * np.clip(r, -_HUBER, _HUBER)[:, None]).reshape(T, -1, p).sum(axis=1)
    inside = j * (abs(r) < _HUBER)[:, None]
    inverse = np.linalg.inv(inside.T @ j + ridge).astype(float)
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
    sums = np.zeros((n, p))
    np.add.at(sums, np.arange(T) * n // T, scores)
    covariance: Array = n * np.cov(sums.T).reshape(p, p)
    factor: float = np.trace(inverse @ covariance).item() / p
    return factor
