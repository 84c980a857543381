"""One epoch of a mode: prediction, noise, gating and update.

A track is a belief (x, P) and a :class:`~mmwave_env.filters.memory.Memory`, statistics of its past
measurements. :func:`predict_update` runs a mode on the coming measurement and returns a
:class:`~mmwave_env.filters.update.ModeResult`. An environment runs every mode; the result of the
mode that the agent chose becomes the new belief and updates the memory (``memory_after``).
"""

from dataclasses import dataclass

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.clock import set_clock
from mmwave_env.filters.custom import check_algorithm
from mmwave_env.filters.gating import Gate, passes
from mmwave_env.filters.memory import Memory
from mmwave_env.filters.modes import Mode, Tuning
from mmwave_env.filters.update import Algorithm, ModeResult
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Measurement, Site
from mmwave_env.models.motion import (
    ProcessNoise,
    accelerate,
    move,
    predict_covariance,
    white_noise_acceleration,
    with_clock,
)
from mmwave_env.numerics.linalg import dot, pack, unpack
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Vector, clip, maximum, where

BLOCKAGE_ONSET_DB = 6.0
BLOCKAGE_SLOPE_DB = 6.0
BLOCKAGE_DEPTH = 3.0
BLOCKAGE_GAIN = 3.0
_SHORTEST_S = 1e-9  # shortest step by which a time is divided
VERTICAL = (2, 5)  # z and vz, which are fixed on flat terrain

_LOWEST_M = -1e9  # below every height; no NaN is above it


@dataclass(frozen=True)
class Pipeline:
    """The parts of a filter that are fixed when a track starts.

    Attributes:
        modes: the modes that are available.
        layout: which quantity is in which row of a measurement.
        planar: whether the terrain is flat, so that z and vz keep their prior values (paper, Sec.
            II-A). The spacing of sigma points still assumes seven uncertain components.
        correlation_s: time for which errors of measurements last; measurements at shorter steps
            repeat each other's errors, and get so much more noise.

    Raises:
        AlgorithmError: a user's algorithm cannot run at all, or cannot run on SIMD lanes; the
            message names the line and says what to write instead.
    """

    modes: tuple[Mode, ...]
    layout: Layout
    planar: bool = False
    correlation_s: float = 0.0

    def __post_init__(self) -> None:
        for mode in self.modes:
            check_algorithm(mode, self.layout, self.known_axes)

    def predict(
        self,
        mode: Mode,
        x: Vector,
        P: Matrix,
        noise: ProcessNoise,
        dt: Number,
        hz_per_mps: Number | None,
    ) -> tuple[Numbers, Matrix]:
        """Return the Kalman prediction, exact for every algorithm because motion is linear."""
        return move(x, dt, hz_per_mps), predict_covariance(P, noise, dt, hz_per_mps)

    def update(self, mode: Mode) -> Algorithm:
        """Return the measurement update of a mode."""
        return mode.update

    @property
    def known_axes(self) -> tuple[int, ...]:
        """Return the state components that are known exactly."""
        return VERTICAL if self.planar else ()

    @property
    def position_axes(self) -> tuple[int, ...]:
        """Return the position components that are estimated: all, or x and y on flat terrain."""
        return (0, 1) if self.planar else (0, 1, 2)

    def prior(self, x: Vector, truth: Vector) -> Numbers:
        """Return the mean of a track's prior, given the prior x (7,) of its episode.

        On flat terrain the vertical speed is 0, and the height is known: that of the true state
        (6,) in the first epoch, or that of ``x`` if the truth is unknown (NaN).
        """
        mean = list(x)
        if self.planar:
            mean[2] = where(truth[2] > _LOWEST_M, truth[2], x[2])
            mean[5] = x[5] - x[5]  # 0 in every lane
        return mean

    def belief(self, x: Numbers, P: Vector) -> Belief:
        """Return the belief with mean (7,) and a covariance packed as its lower triangle (28,)."""
        return Belief(x, unpack(P, zero=self.known_axes), self.position_axes)


def process_noise(
    tuning: Tuning, epoch: Epoch, hz_per_mps: Number, gamma: Number, planar: bool
) -> ProcessNoise:
    """Return Q times gamma; the Doppler spread raises the variances of vx and vy in Q."""
    t = tuning
    velocity = t.sigma_v * t.sigma_v + t.spread_gain * epoch.doppler_spread_hz
    position = t.sigma_p * t.sigma_p
    drift = t.sigma_b_mps * hz_per_mps
    height, climb = (0.0, 0.0) if planar else (t.sigma_pz * t.sigma_pz, t.sigma_vz * t.sigma_vz)
    return white_noise_acceleration(
        [gamma * v for v in (position, position, height)],
        [gamma * v for v in (velocity, velocity, climb)],
        gamma * (drift * drift),
        epoch.dt,
        t.coupling,
    )


def measurement_of(
    mode: Mode, memory: Memory, epoch: Epoch, site: Site, layout: Layout
) -> Measurement:
    """Return the epoch's measurement with the noise that the mode assumes."""
    gamma = memory.gamma if mode.adaptive else 1.0
    variance = [gamma * (s * s) for s in epoch.sigma]
    if mode.blockage_aware:
        for link in range(layout.anchors):  # more noise if the SNR fell below its running mean
            fall_db = memory.snr_mean_db[link] - epoch.snr_db[link] - BLOCKAGE_ONSET_DB
            depth = clip(fall_db * (1.0 / BLOCKAGE_SLOPE_DB), 0.0, BLOCKAGE_DEPTH)
            factor = 1.0 + BLOCKAGE_GAIN * depth
            rows = layout.link(link)
            variance[rows] = [v * factor for v in variance[rows]]
    return Measurement(
        site.anchors, site.hz_per_mps, epoch.z, variance, epoch.visible, layout, epoch.measured,
        epoch.doppler_of,
    )  # fmt: skip


def _repeats(dt: Number, correlation_s: float) -> Number:
    """Return by how much to multiply the noise of errors that last longer than a step ``dt``, s.

    Then n measurements within the time of correlation add the information of one.
    """
    if not correlation_s:
        return 1.0
    return where(dt > 0.0, maximum(correlation_s / maximum(dt, _SHORTEST_S), 1.0), 1.0)


def predict(
    pipeline: Pipeline,
    mode: Mode,
    x: Vector,
    P: Vector,
    gamma: Number,
    epoch: Epoch,
    hz_per_mps: Number,
    tuning: Tuning | None = None,
) -> tuple[Numbers, Matrix]:
    """Predict the mean (7,) and the covariance (7, 7) of a mode for the coming epoch.

    ``gamma`` is the adaptive scale of Q, which modes that are not adaptive ignore. The other
    arguments are the same as for :func:`predict_update`.
    """
    scale = gamma if mode.adaptive else 1.0
    tuning = tuning or mode.tuning
    noise = process_noise(tuning, epoch, hz_per_mps, scale, pipeline.planar)
    drive = pipeline.layout.bias_drive(hz_per_mps)
    if pipeline.layout.has_bias:
        noise = with_clock(noise, drive, epoch.dt, tuning.coupling)
    x_predicted, P_predicted = pipeline.predict(
        mode, x, unpack(P, zero=pipeline.known_axes), noise, epoch.dt, drive
    )
    x_predicted = [x[i] if i in pipeline.known_axes else v for i, v in enumerate(x_predicted)]
    if mode.acceleration_mps2:
        x_predicted = accelerate(x_predicted, tuning.acceleration_mps2, epoch.dt)
    return x_predicted, P_predicted


def predict_update(
    pipeline: Pipeline,
    mode: Mode,
    x: Vector,
    P: Vector,
    memory: Memory,
    epoch: Epoch,
    site: Site,
    tuning: Tuning | None = None,
) -> ModeResult:
    """Run one mode of a pipeline on the coming epoch.

    Args:
        x, P: mean (7,) and packed covariance (28,) after the previous epoch, or of the prior.
        memory: the memory of the track.
        site: anchors and carrier.
        tuning: motion model to use instead of the mode's own; None for the mode's own.
    """
    x_predicted, P_predicted = predict(
        pipeline, mode, x, P, memory.gamma, epoch, site.hz_per_mps, tuning
    )
    force = 0.0
    if mode.recovery is not None:
        force = where(memory.lockout > mode.recovery - 0.5, 1.0, 0.0)
    measurement = measurement_of(mode, memory, epoch, site, pipeline.layout)
    repeats = _repeats(epoch.dt, pipeline.correlation_s)
    gate = Gate(mode.gate, force, mode.robust)
    update = pipeline.update(mode)
    clock = None
    if pipeline.layout.clock == "free":
        clock = set_clock(x_predicted, P_predicted, measurement, memory.lockout, repeats)
        measurement = clock.measurement
        posterior = update(clock.x, clock.P, measurement, gate)
    else:
        noise = [v * repeats for v in measurement.variance]
        measurement = measurement._replace(variance=noise)
        posterior = update(x_predicted, P_predicted, measurement, gate)
    quantile = None if mode.robust else mode.gate
    degrees = pipeline.layout.degrees(measurement.measured)
    within = [passes(q, k, quantile) for q, k in zip(posterior.nis, degrees, strict=True)]
    if clock:  # a link whose only row is the pivot's range has not passed
        within = [where(k > 0.5, w, 0.0) for w, k in zip(within, degrees, strict=True)]
        posterior = clock.judged(posterior)
    x, P, nis, accepted, likelihood = posterior
    passed = dot(within, accepted[: pipeline.layout.anchors])
    return ModeResult(x, pack(P), x_predicted, pack(P_predicted), nis, accepted, passed, likelihood)
