"""Posterior Cramer-Rao bound of a track: the least error that any filter can reach.

With linear motion x_{k+1} = F x_k + w, w ~ N(0, Q), and Gaussian measurement noise R, the
recursion of Tichavsky, Muravchik and Nehorai 1998 for the information J of the state,

    J_{k+1} = D22 - D21 (J_k + D11)^-1 D12,   J_0 = P0^-1 + E[H_0' R_0^-1 H_0],
    D11 = F' Q^-1 F,   D12 = D21' = -F' Q^-1,   D22 = Q^-1 + E[H_{k+1}' R_{k+1}^-1 H_{k+1}],

becomes by the matrix inversion lemma

    J_{k+1} = (F J_k^-1 F' + Q)^-1 + E[H_{k+1}' R_{k+1}^-1 H_{k+1}],

which needs no inverse of Q. With covariances P = J^-1 it needs no other inverse either, so a
singular Q is allowed. H is taken at the true states, and a missing group has no information.

*Averaged bound*: E is the mean over tracks, sigmas and detections (the information reduction
of Hernandez, Ristic, Farina and Timmoneri 2004). No filter that knows Q beats it in the mean
over those tracks. *Conditional bound*: the same recursion with one track's own information
and nothing averaged, the covariance of an EKF that linearizes at the truth. Its mean is never
below the averaged bound (Jensen: J^-1 is convex in the fisher), and is more telling where
information varies along the streets; but given the track it is a benchmark, not a strict bound.

Both bounds hold for tracks that follow F and Q. Real users do not: with the Q of
:func:`measured_motion` the bound is that of a Gaussian model with the same second moments, not
a strict bound for real maneuvers. Sigmas and detections are taken as given: they depend on the
position, but that information is not counted (filters do not use it). The biases of blockage
and multipath are left out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.models.measurement import STATE_SIZE, Measurement, groups_of
from mmwave_env.models.motion import ProcessNoise, predict_covariance, white_noise_acceleration
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode


class Motion(NamedTuple):
    """Constant velocity with white-noise acceleration, as variances per second."""

    position: Sequence[float]  # (3,) extra position noise, m^2 / s
    velocity: Sequence[float]  # (3,) velocity noise, (m/s)^2 / s
    bias: float  # oscillator bias, Hz^2 / s

    def noise(self, dt: float) -> ProcessNoise:
        """Return Q of a step of ``dt`` seconds, with velocity and position coupled."""
        return white_noise_acceleration(self.position, self.velocity, self.bias, dt, 1.0)


def measured_motion(episodes: Sequence[Episode], drift_mps: float) -> Motion:
    """Return the motion with the second moments of true velocity increments.

    The variance of an axis is its mean square increment per second, horizontal axes pooled. On flat
    ground the vertical variance is zero, although filters assume a positive value: a filter may
    know the height (``planar=True``), and a bound must not lie above that filter's error.

    Args:
        episodes: episodes with truth.
        drift_mps: random walk of the oscillator, (m/s) / sqrt(s).
    """
    squares, elapsed, drift = np.zeros(3), 0.0, 0.0
    for episode in episodes:
        _, velocity = _truth(episode)
        squares += np.square(np.diff(velocity, axis=0)).sum(axis=0)
        elapsed += float(np.ptp(episode.time_s))
        drift += (drift_mps * episode.hz_per_mps) ** 2 / len(episodes)
    per_second = squares / elapsed if elapsed else squares
    horizontal = float(per_second[:2].mean())
    return Motion([0.0] * 3, [horizontal, horizontal, float(per_second[2])], drift)


def information(episode: Episode) -> Array:
    """Compute H' R^-1 H (T, 7, 7) of each epoch, zero where all measurements are missing.

    H has units of z (m, rad, Hz, m/s) over units of the state (m, m/s, Hz).
    """
    (position, velocity), T = _truth(episode), len(episode)
    state = [*position.T, *velocity.T, np.zeros(T)]  # h is linear in the oscillator bias
    keep = np.repeat(episode.usable, episode.layout.widths, axis=1)
    sigma = np.where(keep, episode.sigma, 1.0)
    measurement = Measurement(
        anchors=episode.scene_anchors_m.tolist(),
        hz_per_mps=episode.hz_per_mps,
        z=[np.zeros(T)] * episode.layout.size,
        variance=list(np.square(sigma.T)),
        visible=list(episode.usable.T.astype(float)),
        layout=episode.layout,
    )
    jacobian, weight = [], []
    for group, visible in zip(groups_of(state, measurement), measurement.visible, strict=True):
        for row, row_variance in zip(group.jacobian, group.variance, strict=True):
            jacobian.append([np.broadcast_to(entry, T) for entry in row])
            weight.append(visible / row_variance)
    H, inverse_variance = np.array(jacobian), np.array(weight)  # (rows, 7, T), (rows, T)
    weighted = H * inverse_variance[:, None]
    fisher: Array = np.transpose(weighted, (2, 1, 0)) @ np.transpose(H, (2, 0, 1))
    return fisher


def recursion(prior: Array, time_s: Array, fisher: Array, motion: Motion) -> Array:
    """Compute bounds (..., T, 7, 7) on the covariance of the state after each epoch.

    P+ = F P F' + Q, then P = (P+^-1 + I)^-1 = (1 + P+ I)^-1 P+ with the epoch's information I.

    Args:
        prior: (7, 7) covariance P0 at the first epoch, before its measurement.
        time_s: (T,) times of the epochs.
        fisher: (..., T, 7, 7) information of each epoch, of any number of tracks at once.
        motion: motion model that gives Q.
    """
    bound, identity = np.empty_like(fisher), np.eye(STATE_SIZE)
    P = np.broadcast_to(prior, fisher[..., 0, :, :].shape)
    for k, dt in enumerate(np.diff(time_s, prepend=time_s[0])):
        entries = [[P[..., i, j] for j in range(STATE_SIZE)] for i in range(STATE_SIZE)]
        predicted: Array = np.array(predict_covariance(entries, motion.noise(dt), dt))
        predicted = np.moveaxis(predicted, (0, 1), (-2, -1))
        updated = np.linalg.solve(identity + predicted @ fisher[..., k, :, :], predicted)
        # Without the symmetric part, rounding errors would grow.
        bound[..., k, :, :] = 0.5 * (updated + np.swapaxes(updated, -1, -2))
        P = bound[..., k, :, :]
    return bound


def averaged_bound(episodes: Sequence[Episode], motion: Motion) -> Array:
    """Compute the bound (T, 7, 7) on mean square errors over episodes drawn alike.

    Raises:
        ValueError: no episode, one without truth, or different steps or priors.
    """
    first = _alike(episodes)
    total = sum((information(e) for e in episodes), np.zeros((len(first), STATE_SIZE, STATE_SIZE)))
    return recursion(first.prior_covariance, first.time_s, total / len(episodes), motion)


def conditional_bounds(episodes: Sequence[Episode], motion: Motion) -> Array:
    """Compute the bounds (N, T, 7, 7) given each episode's track, sigmas and detections.

    Raises:
        ValueError: same cases as in :func:`averaged_bound`.
    """
    first = _alike(episodes)
    fisher = np.array([information(episode) for episode in episodes])
    return recursion(first.prior_covariance, first.time_s, fisher, motion)


def position_variance(bound: Array) -> Array:
    """Sum the position's diagonal entries (...,) of covariances (..., 7, 7), m^2."""
    return np.einsum("...ii->...", bound[..., :3, :3])  # type: ignore[no-any-return]


def _truth(episode: Episode) -> tuple[Array, Array]:
    """Return true positions and velocities (T, 3)."""
    episode.require_truth()
    assert episode.truth_position_m is not None and episode.truth_velocity_mps is not None
    return episode.truth_position_m, episode.truth_velocity_mps


def _alike(episodes: Sequence[Episode]) -> Episode:
    """Return the first episode, once all have its steps and prior covariance."""
    if not episodes:
        raise ValueError("episodes: found none, expected at least one")
    first = episodes[0]
    for episode in episodes:
        same_steps = len(episode) == len(first) and np.allclose(
            np.diff(episode.time_s), np.diff(first.time_s)
        )
        if not same_steps or not np.array_equal(episode.prior_covariance, first.prior_covariance):
            raise ValueError(
                f"episodes: found {episode.name!r} with other steps or another prior covariance "
                f"than {first.name!r}, expected all alike"
            )
    return first
