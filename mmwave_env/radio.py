"""The radio: from geometry to signal-to-noise ratio, noise, blockage and what is detected.

Noise is a floor (calibration, array errors) and the Cramer-Rao bound at the link's SNR, in
quadrature. Blockage lowers the SNR and biases a link, multipath biases it silently; the
filters are told neither.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mmwave_env.measurement import SPEED_OF_LIGHT, Layout
from mmwave_env.names import choose
from mmwave_env.scene import Scene

Array = NDArray[np.float64]


def _degrees(value: float) -> float:
    return math.radians(value)


@dataclass(frozen=True)
class Radio:
    """A radio profile.

    Sources: path loss of 3GPP TR 38.901, Table 7.4.1-1 (UMi, line of sight); Cramer-Rao bounds
    of Kay 1993, Secs. 3.11 and 15.10; all other figures are this project's model.

    Attributes:
        name: of the profile.
        gnb_elements, ue_elements: antenna elements a side of the square arrays.
        range_floor_m: range noise floor on the direct path and on reflections, m.
        aoa_floor_rad, aod_floor_rad, elevation_floor_rad: angle noise floors.
        doppler_floor_mps: Doppler noise floor, m/s (times f_c / c in hertz).
        prior_position_m: standard deviation of the prior's horizontal position.
        prior_height_m, prior_velocity_mps, prior_vertical_mps, prior_bias_mps: others, per axis.
        transmit_dbm, gnb_gain_db, ue_gain_db, implementation_loss_db: link budget.
        noise_figure_db: of the receiver.
        reflection_loss_db: on a virtual anchor's path.
        blockage_loss_db: while blocked.
        shadowing_db, shadowing_correlation: log-normal, AR(1) per second.
        detection_snr_db, detection_slope_db: logistic probability of detection.
        doppler_window_s: coherent processing interval T.
        blockage_scale, blockage_base, blockage_per_100m, blockage_limit: stationary
            probability scale * min(limit, base + per_100m d / 100 m).
        blockage_mean_s: mean length of a blockage.
        blockage_range_m: mean of its exponential range bias.
        blockage_angle_rad: standard deviation of its angle biases.
        multipath_rate_hz: onsets per second and link.
        multipath_mean_s: mean length.
        multipath_range_m: (constant, mean of the exponential) parts of its range bias.
        multipath_angle_rad: standard deviation of its angle biases.
        outage_rate_hz, outage_mean_s: loss of all links.
        spread_gain, spread_sigma, spread_floor_mps: Doppler spread = gain * speed *
            lognormal(sigma) + |N(0, floor)|, m/s.
        drift_mps: random walk of the oscillator bias, (m/s) / sqrt(s).
        odometry_speed_mps, odometry_heading_rad: odometry noise.
        odometry_slowest_mps: below it odometry gives no heading and is missing.
    """

    name: str
    gnb_elements: int = 8
    ue_elements: int = 4
    range_floor_m: tuple[float, float] = (0.2, 0.4)
    aoa_floor_rad: float = _degrees(1.0)
    aod_floor_rad: float = _degrees(0.5)
    elevation_floor_rad: float = _degrees(0.7)
    doppler_floor_mps: float = 0.1
    prior_position_m: float = 3.0
    prior_height_m: float = 0.5
    prior_velocity_mps: float = 2.0
    prior_vertical_mps: float = 0.1
    prior_bias_mps: float = 0.5
    transmit_dbm: float = 27.0
    gnb_gain_db: float = 21.0
    ue_gain_db: float = 12.0
    implementation_loss_db: float = 10.0
    noise_figure_db: float = 8.0
    reflection_loss_db: float = 8.0
    blockage_loss_db: float = 25.0
    shadowing_db: float = 3.0
    shadowing_correlation: float = 0.9
    detection_snr_db: float = 4.0
    detection_slope_db: float = 1.5
    doppler_window_s: float = 0.01
    blockage_scale: float = 0.5
    blockage_base: float = 0.03
    blockage_per_100m: float = 0.12
    blockage_limit: float = 0.35
    blockage_mean_s: float = 4.0
    blockage_range_m: float = 3.0
    blockage_angle_rad: float = _degrees(3.0)
    multipath_rate_hz: float = 0.008
    multipath_mean_s: float = 3.3
    multipath_range_m: tuple[float, float] = (1.0, 4.0)
    multipath_angle_rad: float = _degrees(5.0)
    outage_rate_hz: float = 0.0
    outage_mean_s: float = 3.0
    spread_gain: float = 0.3
    spread_sigma: float = 0.2
    spread_floor_mps: float = 0.3
    drift_mps: float = 0.05
    odometry_speed_mps: float = 0.1
    odometry_heading_rad: float = _degrees(3.0)
    odometry_slowest_mps: float = 0.2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "name" and not np.isfinite(value).all():
                raise ValueError(f"{name} of radio {self.name!r}: found {value}, expected finite")
        for field in (
            "gnb_elements", "ue_elements", "aoa_floor_rad", "aod_floor_rad",
            "elevation_floor_rad", "doppler_floor_mps", "prior_position_m", "prior_height_m",
            "prior_velocity_mps", "prior_vertical_mps", "prior_bias_mps", "detection_slope_db",
            "doppler_window_s", "blockage_mean_s", "multipath_mean_s", "outage_mean_s",
            "odometry_speed_mps", "odometry_heading_rad",
        ):  # fmt: skip
            if not getattr(self, field) > 0.0:
                raise ValueError(
                    f"{field} of radio {self.name!r}: found {getattr(self, field)}, expected > 0"
                )
        for field in (
            "shadowing_db", "blockage_scale", "blockage_base", "blockage_per_100m",
            "blockage_limit", "blockage_range_m", "blockage_angle_rad", "multipath_rate_hz",
            "multipath_angle_rad", "outage_rate_hz", "spread_gain", "spread_sigma",
            "spread_floor_mps", "drift_mps",
        ):  # fmt: skip
            if not getattr(self, field) >= 0.0:
                raise ValueError(
                    f"{field} of radio {self.name!r}: found {getattr(self, field)}, expected >= 0"
                )
        for field, least in (("range_floor_m", "> 0"), ("multipath_range_m", ">= 0")):
            pair = getattr(self, field)
            bounded = all(v > 0.0 if least == "> 0" else v >= 0.0 for v in pair)
            if len(pair) != 2 or not bounded:
                raise ValueError(
                    f"{field} of radio {self.name!r}: found {pair}, expected two numbers {least}"
                )
        if not 0.0 <= self.shadowing_correlation <= 1.0:
            raise ValueError(
                f"shadowing_correlation of radio {self.name!r}: found "
                f"{self.shadowing_correlation}, expected a number in [0, 1]"
            )

    @property
    def link_budget_db(self) -> float:
        """SNR at no path loss, before the thermal noise of the bandwidth."""
        return self.transmit_dbm + self.gnb_gain_db + self.ue_gain_db - self.implementation_loss_db

    def snr_db(self, path_gain_db: Array, bandwidth_hz: float) -> Array:
        """SNR of links with the given path gain (negative, dB)."""
        thermal_dbm = -174.0 + 10.0 * math.log10(bandwidth_hz) + self.noise_figure_db
        return self.link_budget_db + path_gain_db - thermal_dbm

    def sigma(self, snr_db: Array, scene: Scene, layout: Layout) -> Array:
        """Standard deviations (T, rows) of every row at SNRs (T, L): m, rad, Hz."""
        snr = 10.0 ** (np.clip(snr_db, -30.0, 80.0) / 10.0)
        sigma = np.empty((len(snr), layout.size))
        effective_hz = scene.bandwidth_hz / math.sqrt(12.0)
        bound = SPEED_OF_LIGHT / (2.0 * math.pi * effective_hz * np.sqrt(2.0 * snr))
        floor = np.full(layout.anchors, self.range_floor_m[1])
        floor[0] = self.range_floor_m[0]
        links = sigma[:, : 4 * layout.anchors].reshape(len(snr), layout.anchors, 4)
        links[..., 0] = np.hypot(floor, bound)
        links[..., 1] = np.hypot(self.aoa_floor_rad, self._angle_bound(snr, self.ue_elements))
        links[..., 2] = np.hypot(self.elevation_floor_rad, self._angle_bound(snr, self.ue_elements))
        links[..., 3] = np.hypot(self.aod_floor_rad, self._angle_bound(snr, self.gnb_elements))
        doppler_bound = np.sqrt(6.0 / snr[:, 0]) / (2.0 * math.pi * self.doppler_window_s)
        sigma[:, layout.doppler] = np.hypot(
            self.doppler_floor_mps * scene.hz_per_mps, doppler_bound
        )
        if layout.odometry:
            sigma[:, layout.doppler + 1] = self.odometry_speed_mps
            sigma[:, layout.doppler + 2] = self.odometry_heading_rad
        return sigma

    @staticmethod
    def _angle_bound(snr: Array, elements: int) -> Array:
        # A single element has no aperture; two are the least that measure an angle.
        return np.sqrt(6.0 / (snr * (max(elements, 2) ** 2 - 1.0))) / math.pi

    def prior_covariance(self, scene: Scene) -> Array:
        """P0 (7, 7) of the state at the first epoch."""
        p, v = self.prior_position_m, self.prior_velocity_mps
        bias_hz = self.prior_bias_mps * scene.hz_per_mps
        deviations = [p, p, self.prior_height_m, v, v, self.prior_vertical_mps, bias_hz]
        return np.diag(np.square(deviations))


RADIOS: dict[str, Radio] = {
    "handset": Radio(
        "handset",
        gnb_elements=4,
        ue_elements=2,
        range_floor_m=(0.5, 0.8),
        aoa_floor_rad=_degrees(3.0),
        aod_floor_rad=_degrees(2.0),
        elevation_floor_rad=_degrees(2.0),
        prior_position_m=4.0,
        outage_rate_hz=0.003,
    ),
    "standard": Radio("standard"),
    "high": Radio(
        "high",
        gnb_elements=16,
        ue_elements=8,
        range_floor_m=(0.1, 0.2),
        aoa_floor_rad=_degrees(0.5),
        aod_floor_rad=_degrees(0.25),
        elevation_floor_rad=_degrees(0.4),
        doppler_floor_mps=0.05,
        prior_position_m=2.0,
    ),
}


def radio_from(radio: str | Radio) -> Radio:
    """The profile of a ``radio=`` argument: a name or a Radio."""
    return radio if isinstance(radio, Radio) else choose(RADIOS, radio, "radio")


def oscillator_bias(
    radio: Radio, hz_per_mps: float, time_s: Array, rng: np.random.Generator
) -> Array:
    """The residual carrier offset (T,) at times (T,), Hz: a random walk."""
    first = radio.prior_bias_mps * rng.standard_normal()
    steps = radio.drift_mps * np.sqrt(np.diff(time_s)) * rng.standard_normal(len(time_s) - 1)
    return hz_per_mps * (first + np.concatenate([[0.0], np.cumsum(steps)]))


def doppler_spread(
    radio: Radio, hz_per_mps: float, speed_mps: Array, rng: np.random.Generator
) -> Array:
    """Measured Doppler spread (T,) at speeds (T,), Hz; blind below about 1 m/s."""
    scatter = np.exp(radio.spread_sigma * rng.standard_normal(len(speed_mps)))
    floor = radio.spread_floor_mps * np.abs(rng.standard_normal(len(speed_mps)))
    return hz_per_mps * (radio.spread_gain * speed_mps * scatter + floor)


class Channel(NamedTuple):
    """What the channel does over an episode.

    Attributes:
        snr_db: (T, L).
        detected: (T, L) bool.
        range_bias_m: (T, L) from blockage and multipath.
        angle_bias_rad: (T, L, 3) of AoA azimuth, AoA elevation and AoD azimuth.
        doppler_spread_hz: (T,).
    """

    snr_db: Array
    detected: NDArray[np.bool_]
    range_bias_m: Array
    angle_bias_rad: Array
    doppler_spread_hz: Array


def simulate_channel(
    radio: Radio, scene: Scene, distance_m: Array, speed_mps: Array, dt: float,
    rng: np.random.Generator,
) -> Channel:  # fmt: skip
    """Draw a channel along a track.

    Args:
        radio, scene: profile and carrier.
        distance_m: (T, L) to every anchor.
        speed_mps: (T,).
        dt: step, seconds.
        rng: source of all randomness.
    """
    T, L = distance_m.shape
    loss = 32.4 + 21.0 * np.log10(distance_m) + 20.0 * math.log10(scene.carrier_hz / 1e9)
    loss[:, 1:] += radio.reflection_loss_db
    rho = radio.shadowing_correlation**dt
    shadowing = radio.shadowing_db * _autoregress(rng.standard_normal((T, L)), rho)

    probability = radio.blockage_scale * np.minimum(
        radio.blockage_limit, radio.blockage_base + radio.blockage_per_100m * distance_m / 100.0
    )
    leave = -math.expm1(-dt / radio.blockage_mean_s)
    onset = leave * probability / np.maximum(1.0 - probability, 1e-9)
    blocked, blockage = _spells(rng.random((T, L)), onset, leave, probability[0])
    rate = -math.expm1(-dt * radio.multipath_rate_hz)
    end = -math.expm1(-dt / radio.multipath_mean_s)
    reflected, multipath = _spells(rng.random((T, L)), np.full((T, L), rate), end, np.zeros(L))
    lost, _ = _spells(
        rng.random((T, 1)),
        np.full((T, 1), -math.expm1(-dt * radio.outage_rate_hz)),
        -math.expm1(-dt / radio.outage_mean_s),
        np.zeros(1),
    )

    # One bias a spell: drawn for every epoch, taken at the epoch in which the spell began.
    blockage_bias = radio.blockage_range_m * rng.standard_exponential((T, L))
    constant, mean = radio.multipath_range_m
    multipath_bias = constant + mean * rng.standard_exponential((T, L))
    angles = rng.standard_normal((2, T, L, 3))
    link = np.arange(L)
    range_bias = blocked * blockage_bias[blockage, link]
    range_bias += reflected * multipath_bias[multipath, link]
    angle_bias = blocked[..., None] * radio.blockage_angle_rad * angles[0, blockage, link]
    angle_bias += reflected[..., None] * radio.multipath_angle_rad * angles[1, multipath, link]

    snr = radio.snr_db(-loss + shadowing - radio.blockage_loss_db * blocked, scene.bandwidth_hz)
    chance = 1.0 / (1.0 + np.exp(-(snr - radio.detection_snr_db) / radio.detection_slope_db))
    detected = (rng.random((T, L)) < chance) & ~lost
    spread_hz = doppler_spread(radio, scene.hz_per_mps, speed_mps, rng)
    return Channel(snr, detected, range_bias, angle_bias, spread_hz)


@numba.njit(cache=True)
def _autoregress(noise, rho):  # type: ignore[no-untyped-def]
    """Stationary AR(1) of unit variance per column, from white noise (T, L)."""
    out = noise.copy()
    fresh = np.sqrt(1.0 - rho * rho)
    for t in range(1, len(noise)):
        for i in range(noise.shape[1]):
            out[t, i] = rho * out[t - 1, i] + fresh * noise[t, i]
    return out


@numba.njit(cache=True)
def _spells(uniform, onset, leave, first):  # type: ignore[no-untyped-def]
    """A two-state Markov chain per column: whether it is on (T, L), and since which epoch."""
    T, L = uniform.shape
    on = np.zeros((T, L), np.bool_)
    since = np.zeros((T, L), np.int64)
    for i in range(L):
        for t in range(T):
            if t == 0:
                on[t, i] = uniform[t, i] < first[i]
            elif on[t - 1, i]:
                on[t, i] = uniform[t, i] >= leave
                since[t, i] = since[t - 1, i]
            else:
                on[t, i] = uniform[t, i] < onset[t, i]
                since[t, i] = t
    return on, since
