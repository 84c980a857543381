"""What a filter is given: an epoch of measurements, and what holds through an episode."""

from typing import NamedTuple

from mmwave_env.models.measurement import STATE_SIZE, Layout
from mmwave_env.numerics.numbers import Number


class Epoch(NamedTuple):
    """What an epoch brings to the estimator; missing groups hold anything finite."""

    dt: Number  # seconds since the epoch before; 0 in the first epoch, where the prior holds
    z: list[Number]  # (rows,) measured values: m, rad, Hz, m/s
    sigma: list[Number]  # (rows,) their standard deviations, positive
    visible: list[Number]  # (groups,) 1 where measured, else 0
    snr_db: list[Number]  # (L,) signal-to-noise ratio per link, dB
    doppler_spread_hz: Number  # Doppler spread, Hz


class Site(NamedTuple):
    """What stays the same through an episode."""

    anchors: list[list[Number]]  # (L, 3) positions, m
    hz_per_mps: Number  # carrier frequency over the speed of light
    prior_x: list[Number]  # (7,) mean at the first epoch
    prior_P: list[Number]  # (28,) packed covariance at the first epoch


def blank_site(layout: Layout) -> Site:
    """A site that is sound but nowhere, to be overwritten."""
    prior = [float(i == j) for i in range(STATE_SIZE) for j in range(i + 1)]
    anchors = [[0.0, 0.0, 10.0 + a] for a in range(layout.anchors)]
    return Site(anchors, 1.0, [1.0] * STATE_SIZE, prior)
