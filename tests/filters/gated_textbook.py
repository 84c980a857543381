"""Textbook updates with this package's gates, and sensor models with fewer states or rows.

Several functions have an argument ``moments``: a method of ``textbook.METHODS``, such as
``tangent``.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from mmwave_env.filters import Gate, textbook
from mmwave_env.filters.textbook import Sensor, tangent
from mmwave_env.models.layout import Layout


def groups_of(sensor):
    """Return the rows of each link, of the Doppler shift and of the odometry."""
    if isinstance(sensor, Sensor):
        return Layout(sensor.links, sensor.odometry).groups
    return sensor.groups


@dataclass(frozen=True)
class Restricted:
    """Sensor as a function of the ``free`` components of the state; all others equal ``known``."""

    sensor: Sensor
    known: np.ndarray
    free: list[int]

    def _whole(self, x):
        whole = self.known.copy()
        whole[self.free] = x
        return whole

    def h(self, x):
        return self.sensor.h(self._whole(x))

    def jacobian(self, x):
        return self.sensor.jacobian(self._whole(x))[:, self.free]

    def residual(self, a, b, x):
        return self.sensor.residual(a, b, self._whole(x))

    @property
    def groups(self):
        return groups_of(self.sensor)

    @property
    def links(self):
        return self.sensor.links


@dataclass(frozen=True)
class Rows:
    """Sensor with only the rows in ``kept``, a mask (rows,); groups without rows are left out."""

    sensor: Sensor
    kept: np.ndarray

    def h(self, x):
        return self.sensor.h(x)[self.kept]

    def jacobian(self, x):
        return self.sensor.jacobian(x)[self.kept]

    def residual(self, a, b, x):
        whole = np.zeros((2, len(self.kept)))
        whole[:, self.kept] = a, b
        return self.sensor.residual(*whole, x)[self.kept]

    @property
    def groups(self):
        ends = np.cumsum([0, *(int(self.kept[group].sum()) for group in groups_of(self.sensor))])
        return [slice(a, b) for a, b in pairwise(ends) if b > a]

    @property
    def links(self):
        return sum(self.kept[group].any() for group in groups_of(self.sensor)[: self.sensor.links])


class Update(NamedTuple):
    x: np.ndarray
    P: np.ndarray
    nis: np.ndarray
    accepted: np.ndarray
    log_likelihood: float


def gate_groups(moments, sensor, x, P, z, R, visible, gate):
    """Gate each group at the prior; a robust update inflates R of links with a large NIS.

    Returns R, the mask of accepted rows, and the last three fields of an :class:`Update`.
    """
    mean, S, _ = moments(sensor, x, P)
    S = S + np.diag(R)
    y = sensor.residual(z, mean, x)
    groups = groups_of(sensor)
    nis = np.array([y[g] @ np.linalg.inv(S[g, g]) @ y[g] for g in groups])
    log_det = np.array([np.log(np.linalg.det(S[g, g])) for g in groups])
    sizes = np.array([g.stop - g.start for g in groups])
    is_link = np.arange(len(groups)) < sensor.links
    passed = nis <= (np.inf if gate.quantile is None else chi2.ppf(gate.quantile, sizes))
    if gate.force or gate.robust:
        passed = passed | is_link
    if gate.robust:
        doubt = np.where(is_link, np.maximum(nis / (1.5 * sizes), 1.0) ** 2, 1.0)
        R = R * np.repeat(doubt, sizes)
    log_likelihood = -0.5 * np.sum((nis + log_det)[visible])
    accepted = visible & passed
    return R, np.repeat(accepted, sizes), np.where(visible, nis, 0.0), accepted, log_likelihood


def update(moments, sensor, x, P, z, R, *gate):
    """Gate each group at the prior, then condition on all rows of the groups that passed."""
    R, keep, *judged = gate_groups(moments, sensor, x, P, z, R, *gate)
    return Update(*textbook.update(moments, sensor, x, P, z, R, keep), *judged)


def iterated(iterations, sensor, x, P, z, R, *gate):
    """Run an iterated EKF update (Bell and Cathey 1993, eq. for x_i+1), gated at the prior."""
    R, keep, *judged = gate_groups(tangent, sensor, x, P, z, R, *gate)
    R = np.diag(R[keep])
    iterate = x
    for _ in range(iterations):
        H = sensor.jacobian(iterate)[keep]
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        residual = sensor.residual(z, sensor.h(iterate), iterate)[keep]
        iterate = x + K @ (residual - H @ (x - iterate))
    A = np.eye(len(x)) - K @ H
    return Update(iterate, A @ P @ A.T + K @ R @ K.T, *judged)


def textbook_imm(episode, modes, transitions, nis_quantile, change):
    """Run the IMM of Bar-Shalom, Li and Kirubarajan 2001, Sec. 11.6.6, without gates.

    ``modes`` are pairs (method, Q of one second); noise is not adapted. ``transitions`` has one
    matrix per epoch. In likelihoods, NIS is capped at the chi-square quantile of
    ``nis_quantile``. The function ``change(t, probabilities)`` may replace the probabilities after
    epoch t. The results are x (T, 7), P (T, 7, 7) and probabilities (T, M).
    """
    most = chi2.ppf(nis_quantile, [4, 4, 4, 1])
    sensor = textbook.Sensor(episode.scene_anchors_m, episode.hz_per_mps)
    M = len(modes)
    probability = np.full(len(modes), 1.0 / len(modes))
    x = np.tile(episode.prior_mean, (M, 1))
    P = np.tile(episode.prior_covariance, (M, 1, 1))
    out = []
    for t in range(len(episode)):
        dt = episode.time_s[t] - episode.time_s[t - 1] if t else 0.0
        predicted, mixed_x, mixed_P = textbook.mix(probability, transitions[t], x, P)
        log_likelihood = np.empty(M)
        for j, (method, Q) in enumerate(modes):
            prior = textbook.predict(mixed_x[j], mixed_P[j], Q * dt, dt)
            measured = episode.table()[t, 1:14], episode.sigma[t] ** 2, episode.usable[t]
            step = update(textbook.METHODS[method], sensor, *prior, *measured, Gate(None))
            x[j] = step.x
            P[j] = step.P
            log_likelihood[j] = step.log_likelihood + 0.5 * np.maximum(step.nis - most, 0.0).sum()
        probability = textbook.reweigh(predicted, log_likelihood)
        probability = change(t, probability)
        out.append((*textbook.combine(probability, x, P), probability))
    return [np.array(column) for column in zip(*out, strict=True)]
