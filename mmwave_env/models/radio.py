"""Radio profiles: link budget, noise, and the rates of the channel's disturbances.

The noise variance is a floor (calibration, array errors) plus the Cramer-Rao bound at the link's
SNR. Blockage lowers the SNR of a link and biases its measurements; multipath biases them without
changing the SNR. The filters do not know which links are affected. In training, profiles may be
random (:func:`random_radio`), so that a policy cannot memorize the noise of one profile.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from mmwave_env.io.files import AnyPath, Json, shipped_json
from mmwave_env.io.lookup import as_name, choose, quoted, unknown
from mmwave_env.io.records import (
    Bound,
    Name,
    Probability,
    between,
    counts,
    hints_of,
    object_from,
    read_object,
    require_fields,
)
from mmwave_env.models import envelope
from mmwave_env.models.layout import LINK, Layout
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.motion import CLOCK_SIGMA_M, FREE_BIAS_M
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Number, Numbers, Vector, clip, exp, sqrt

# Radios for which filter modes were tuned; the benchmark and the paper's tables cover all three.
TUNED_RADIOS = ("handset", "standard", "high")
DEGREE = math.pi / 180.0
# Standard deviation per axis of an unknown horizontal velocity: half of the paper's 20 m/s limit.
UNKNOWN_VELOCITY_MPS = 10.0
# prior standard deviation of the range bias, by the state of the user's clock; 100 ns and 3.3 us
BIAS_SIGMA_M = {"offset": SPEED_OF_LIGHT * 1e-7, "free": FREE_BIAS_M}
DECIBEL = math.log(10.0) / 10.0  # natural logarithm of a power ratio of 1 dB
Elements = Annotated[int, counts(1, 1024)]
AngleFloor = Annotated[
    float,
    Bound(
        "1e-05 to pi / 4 rad (in degrees if the name ends in _deg)", least=1e-5, most=45.0 * DEGREE
    ),
]
RangeFloor = Annotated[float, between(1e-9, 1e4, "m")]
Speed = Annotated[float, between(1e-4, 100.0, "m/s")]
PriorPosition = Annotated[float, envelope.POSITION_SIGMA_M]
PriorVelocity = Annotated[float, envelope.VELOCITY_SIGMA_MPS]
Decibel = Annotated[float, between(-300.0, 300.0, "dB")]
Spell = Annotated[float, between(1e-3, 1e6, "s")]  # mean length of blockage, multipath or outage
Rate = Annotated[float, between(0.0, 1e3, "Hz")]
RangeBias = Annotated[float, between(0.0, 1e5, "m")]
AngleBias = Annotated[
    float, Bound("0 to pi rad (in degrees if the name ends in _deg)", least=0.0, most=math.pi)
]
Factor = Annotated[float, between(0.0, 100.0)]
SNR_LIMITS_DB = (-30.0, 80.0)  # beyond these limits, noise no longer depends on the SNR


@dataclass(frozen=True)
class Radio:
    """A radio profile.

    Sources: path loss of 3GPP TR 38.901, Table 7.4.1-1 (UMi, line of sight); Cramer-Rao bounds
    of Kay 1993, Secs. 3.11 and 15.10. All other numbers are assumptions of this project.

    Attributes:
        name: name of the profile.
        gnb_elements, ue_elements: number of antenna elements along one side of the square arrays.
        range_floor_m: noise floors (standard deviations) of the range: [direct path, reflections].
        aoa_floor_rad: noise floor of the azimuth of arrival.
        aod_floor_rad: noise floor of the azimuth of departure.
        elevation_floor_rad: noise floor of the elevation of arrival.
        doppler_floor_mps: Doppler noise floor, m/s (multiply by f_c / c to get hertz).
        prior_position_m: standard deviation of the prior's horizontal position, per axis.
        prior_height_m: standard deviation of the prior's height.
        prior_velocity_mps: standard deviation of the prior's horizontal velocity, per axis.
        prior_vertical_mps: standard deviation of the prior's vertical velocity.
        prior_bias_mps: standard deviation of the prior's oscillator bias.
        start_velocity_mps: standard deviation of the horizontal velocity, per axis, with which the
            track of a log begins.
        transmit_dbm, gnb_gain_db, ue_gain_db, implementation_loss_db: parts of the link budget.
        noise_figure_db: noise figure of the receiver.
        reflection_loss_db: loss on a virtual anchor's path.
        blockage_loss_db: loss while a link is blocked.
        shadowing_db: standard deviation of log-normal shadowing.
        shadowing_correlation: correlation of shadowing, an AR(1) process, over one second.
        detection_snr_db: SNR at which a link is detected with probability 0.5.
        detection_slope_db: scale of the logistic curve of detection probability against SNR.
        doppler_window_s: coherent processing interval T for the Doppler shift.
        blockage_scale, blockage_base, blockage_per_100m, blockage_limit: stationary probability of
            blockage at distance d: scale * min(limit, base + per_100m d / 100 m).
        blockage_mean_s: mean length of a blockage.
        blockage_range_m: mean of the exponential range bias during a blockage.
        blockage_angle_rad: standard deviation of the angle biases during a blockage.
        multipath_rate_hz: rate at which spells of multipath begin, per link.
        multipath_mean_s: mean length of a spell of multipath.
        multipath_range_m: range bias during multipath, m: [constant, mean of an exponential part].
        multipath_angle_rad: standard deviation of the angle biases during multipath.
        outage_rate_hz: rate at which outages begin; in an outage all links are lost.
        outage_mean_s: mean length of an outage.
        spread_gain, spread_sigma, spread_floor_mps: Doppler spread = gain * speed *
            lognormal(sigma) + |N(0, floor)|, m/s.
        drift_mps: standard deviation of the oscillator bias's random walk, (m/s) / sqrt(s).
        odometry_speed_mps, odometry_heading_rad: standard deviations of the odometry's noise.
        odometry_slowest_mps: speed below which there is no odometry, as the heading is undefined.
        base: shipped profile whose filter modes, banks of modes and policies this radio uses; only
            shipped profiles have their own.
    """

    name: Name
    gnb_elements: Elements = 8
    ue_elements: Elements = 4
    range_floor_m: tuple[RangeFloor, RangeFloor] = (0.2, 0.4)
    aoa_floor_rad: AngleFloor = 1.0 * DEGREE
    aod_floor_rad: AngleFloor = 0.5 * DEGREE
    elevation_floor_rad: AngleFloor = 0.7 * DEGREE
    doppler_floor_mps: Speed = 0.1
    prior_position_m: PriorPosition = 3.0
    prior_height_m: PriorPosition = 0.5
    prior_velocity_mps: PriorVelocity = 2.0
    prior_vertical_mps: PriorVelocity = 0.1
    prior_bias_mps: Annotated[float, between(1e-9, 100.0, "m/s")] = 0.5
    start_velocity_mps: PriorVelocity = UNKNOWN_VELOCITY_MPS
    transmit_dbm: Decibel = 27.0
    gnb_gain_db: Decibel = 21.0
    ue_gain_db: Decibel = 12.0
    implementation_loss_db: Decibel = 10.0
    noise_figure_db: Decibel = 8.0
    reflection_loss_db: Decibel = 8.0
    blockage_loss_db: Decibel = 25.0
    shadowing_db: Factor = 3.0
    shadowing_correlation: Probability = 0.9
    detection_snr_db: Decibel = 4.0
    detection_slope_db: Annotated[float, between(0.01, 100.0, "dB")] = 1.5
    doppler_window_s: Annotated[float, between(1e-4, 1e6, "s")] = 0.01
    blockage_scale: Factor = 0.5
    blockage_base: Probability = 0.03
    blockage_per_100m: Factor = 0.12
    blockage_limit: Probability = 0.35
    blockage_mean_s: Spell = 4.0
    blockage_range_m: RangeBias = 3.0
    blockage_angle_rad: AngleBias = 3.0 * DEGREE
    multipath_rate_hz: Rate = 0.008
    multipath_mean_s: Spell = 3.3
    multipath_range_m: tuple[RangeBias, RangeBias] = (1.0, 4.0)
    multipath_angle_rad: AngleBias = 5.0 * DEGREE
    outage_rate_hz: Rate = 0.0
    outage_mean_s: Spell = 3.0
    spread_gain: Factor = 0.3
    spread_sigma: Annotated[float, between(0.0, 3.0)] = 0.2
    spread_floor_mps: Factor = 0.3
    drift_mps: Factor = 0.05
    odometry_speed_mps: Annotated[float, between(1e-3, 100.0, "m/s")] = 0.1
    odometry_heading_rad: Annotated[float, between(1e-5, 10.0, "rad")] = 3.0 * DEGREE
    odometry_slowest_mps: Annotated[float, between(0.0, 100.0, "m/s")] = 0.2
    base: str = "standard"

    def __post_init__(self) -> None:
        if self.base not in TUNED_RADIOS:
            raise ValueError(unknown("base", self.base, TUNED_RADIOS))
        require_fields(self, f" of radio {quoted(self.name)}")

    def snr_db(self, path_gain_db: Number, bandwidth_hz: float) -> Number:
        """Return the SNR of links with the given path gain (negative, dB)."""
        gains_db = self.gnb_gain_db + self.ue_gain_db
        sent_dbm = self.transmit_dbm + gains_db - self.implementation_loss_db
        noise_dbm = -174.0 + 10.0 * math.log10(bandwidth_hz) + self.noise_figure_db  # thermal
        return sent_dbm + path_gain_db - noise_dbm

    def variances(self, scene: Scene, layout: Layout) -> tuple[list[float], list[float]]:
        """Return variances of every row: noise floors, and Cramer-Rao bounds at an SNR of 0 dB.

        The floors of ranges contain the uncertainty of the scene's ``range_offset_m``.
        """
        range_bound = SPEED_OF_LIGHT / (2.0 * math.pi * scene.bandwidth_hz / math.sqrt(12.0))
        arrival = _azimuth_bound(self.ue_elements)
        departure = _azimuth_bound(self.gnb_elements)
        angles = (self.aoa_floor_rad, self.elevation_floor_rad, self.aod_floor_rad)
        offsets = scene.range_offset_sigma_m or [0.0] * layout.anchors
        floor = []
        bound = []
        for anchor in range(layout.anchors):
            range_floor = math.hypot(self.range_floor_m[min(anchor, 1)], offsets[anchor])
            floor += [range_floor, *angles]
            bound += [range_bound**2 / 2.0, arrival, arrival, departure]
        floor.append(self.doppler_floor_mps * scene.hz_per_mps)
        bound.append(6.0 / (2.0 * math.pi * self.doppler_window_s) ** 2)
        if layout.odometry:
            floor += [self.odometry_speed_mps, self.odometry_heading_rad]
            bound += [0.0, 0.0]
        return [f * f for f in floor], bound

    def sigma(self, snr_db: Array, scene: Scene, layout: Layout) -> Array:
        """Return the standard deviations (T, rows) of every row at SNRs (T, L): m, rad, Hz."""
        return np.stack(deviations(*self.variances(scene, layout), list(snr_db.T), layout), axis=1)

    def prior_covariance(self, scene: Scene, clock: str = "synchronized") -> Array:
        """Return the prior covariance P0 (7, 7) of the first epoch; (8, 8) with a range bias."""
        p = self.prior_position_m
        v = self.prior_velocity_mps
        bias_hz = self.prior_bias_mps * scene.hz_per_mps
        deviations = [p, p, self.prior_height_m, v, v, self.prior_vertical_mps, bias_hz]
        if clock in BIAS_SIGMA_M:
            deviations.append(BIAS_SIGMA_M[clock])
        return np.diag(np.square(deviations))


def _azimuth_bound(elements: int) -> float:
    """Return the Cramer-Rao bound of an angle's variance at an SNR of 0 dB.

    A single element cannot measure angles (infinite bound); it gets the bound of two elements.
    """
    return 6.0 / ((max(elements, 2) ** 2 - 1.0) * math.pi**2)


def radio_from(radio: AnyPath | Radio) -> Radio:
    """Return the profile of a ``radio=`` argument: a name, a JSON file or a Radio.

    Raises:
        ValueError: the name is unknown, or :func:`read_radio` refuses the file.
    """
    if isinstance(radio, Radio):
        return radio
    if str(radio).endswith(".json"):
        return read_radio(radio)
    return choose(RADIOS, str(radio), "radio", ", or a .json file")


def read_radio(path: AnyPath) -> Radio:
    """Read a radio from a JSON file, which contains the fields that differ from the base profile.

    The field "base" names the base, a shipped profile; its default is "standard". The default of
    "name" is the file's name. The name of an angle in degrees ends in "_deg" instead of "_rad".

    Raises:
        ValueError: the file is wrong; the message names the file and the error.
        FileNotFoundError: the file does not exist.
    """

    def make(content: Json) -> Radio:
        own = {"name": as_name(Path(path).stem)} | _in_radians(content)
        if own["name"] in list(RADIOS):
            raise ValueError(
                f"name: found {own['name']!r}, a shipped profile's name, expected another name"
            )
        base = choose(RADIOS, own.pop("base", "standard"), "base")
        return object_from(Radio, vars(base) | own)

    return read_object(path, "radio", make)


def _in_radians(content: Json) -> Json:
    """Return the content of a radio's file, with its angles in radians."""
    fields: Json = {}
    for key, value in content.items():
        angle = f"{key.removesuffix('_deg')}_rad"
        in_degrees = key.endswith("_deg") and angle in hints_of(Radio)
        name = angle if in_degrees else key
        if name in fields:
            raise ValueError(f"{key}: found the same angle twice, in degrees and in radians")
        fields[name] = value * DEGREE if in_degrees and type(value) in (int, float) else value
    return fields


# the profiles of the package, by name
RADIOS = {
    name: object_from(Radio, {"name": name, "base": name} | _in_radians(content))
    for name, content in shipped_json("radios").items()
}


def oscillator_bias(
    radio: Radio, hz_per_mps: float, time_s: Array, rng: np.random.Generator
) -> Array:
    """Draw the oscillator bias (T,), Hz, at times (T,), s: a random walk."""
    first = radio.prior_bias_mps * rng.standard_normal()
    steps = radio.drift_mps * np.sqrt(np.diff(time_s)) * rng.standard_normal(len(time_s) - 1)
    return hz_per_mps * (first + np.concatenate([[0.0], np.cumsum(steps)]))


def clock_bias(clock: str, drift_mps: Array, time_s: Array, rng: np.random.Generator) -> Array:
    """Draw a clock's range bias (T,), m: the integral of the drift (T,), m/s, plus noise.

    The range bias of a free clock is all noise.
    """
    if clock == "free":
        return FREE_BIAS_M * rng.standard_normal(len(time_s))
    step = np.diff(time_s)
    first = BIAS_SIGMA_M[clock] * rng.standard_normal()
    noise = CLOCK_SIGMA_M * np.sqrt(step) * rng.standard_normal(len(step))
    driven = 0.5 * step * (drift_mps[1:] + drift_mps[:-1])
    return first + np.concatenate([[0.0], np.cumsum(driven + noise)])


def doppler_spread(
    radio: Radio, hz_per_mps: float, speed_mps: Array, rng: np.random.Generator
) -> Array:
    """Draw the measured Doppler spread (T,), Hz, at speeds (T,); below 1 m/s noise dominates."""
    scatter = np.exp(radio.spread_sigma * rng.standard_normal(len(speed_mps)))
    floor = radio.spread_floor_mps * np.abs(rng.standard_normal(len(speed_mps)))
    return hz_per_mps * (radio.spread_gain * speed_mps * scatter + floor)


def deviations(
    floor_variance: Vector, bound_variance: Vector, snr_db: Vector, layout: Layout
) -> Numbers:
    """Return standard deviations (rows,) at SNRs (L,): floor and Cramer-Rao bound in quadrature.

    Both variances (rows,) come from :meth:`Radio.variances`. The first link's SNR also applies to
    the Doppler shift.
    """
    inverse = [exp(-DECIBEL * clip(snr, *SNR_LIMITS_DB)) for snr in snr_db]
    per_row = [of_link for of_link in inverse for _ in LINK]
    per_row += [inverse[0]] * (layout.size - len(per_row))
    return [
        sqrt(floor + bound * scale)
        for floor, bound, scale in zip(floor_variance, bound_variance, per_row, strict=True)
    ]


# Fields to multiply by random factors. Factors up to 4 keep shipped profiles in Radio's limits.
_SCALED = (  # pairs are multiplied by one factor
    "aoa_floor_rad", "aod_floor_rad", "elevation_floor_rad", "doppler_floor_mps",
    "prior_position_m", "prior_height_m", "prior_velocity_mps", "prior_bias_mps",
    "shadowing_db", "blockage_scale", "blockage_mean_s", "blockage_range_m", "blockage_angle_rad",
    "multipath_rate_hz", "multipath_mean_s", "multipath_angle_rad", "spread_gain",
    "spread_floor_mps", "drift_mps", "range_floor_m", "multipath_range_m",
)  # fmt: skip


def random_radio(
    profile: Radio, rng: np.random.Generator, factor: float = 2.0, budget_db: float = 4.0
) -> Radio:
    """Draw a radio: a profile with random changes of noise, rates and link budget.

    Args:
        profile: profile to change; filters use the modes tuned for it.
        rng: source of all randomness.
        factor: largest factor that a field is multiplied by, up to 4; the smallest is 1 / factor.
            Factors are log-uniformly distributed between these two.
        budget_db: largest change of the link budget, in either direction.
    """
    values: dict[str, Any] = {}
    for name in _SCALED:
        by = float(factor ** rng.uniform(-1.0, 1.0))
        value = getattr(profile, name)
        values[name] = tuple(by * v for v in value) if type(value) is tuple else by * value
    budget = profile.transmit_dbm + float(rng.uniform(-budget_db, budget_db))
    return replace(profile, transmit_dbm=budget, **values)
