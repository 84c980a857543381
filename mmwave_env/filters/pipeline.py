"""One epoch of a mode: predict, handle the noise, gate and update; and what is remembered.

A track is a belief (x, P) and a :class:`Memory` of how the measurements behaved. Every
epoch has two halves: :func:`consider` runs a mode on the coming measurement and returns a
:class:`Candidate`, :func:`commit` takes one candidate as the new belief and remembers it.
An environment considers every mode and commits to the one the agent chose.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from scipy.special import chdtri

from mmwave_env.filters.custom import rehearse
from mmwave_env.filters.modes import Mode, Tuning
from mmwave_env.filters.update import Algorithm, Gate, Posterior, passes
from mmwave_env.models.epoch import Epoch, Site
from mmwave_env.models.measurement import Layout, Measurement
from mmwave_env.models.motion import (
    ProcessNoise,
    move,
    predict_covariance,
    white_noise_acceleration,
)
from mmwave_env.numerics.linalg import dot, pack, unpack
from mmwave_env.numerics.numbers import Matrix, Number, Vector, clip, maximum, sqrt, where

WINDOW = 10  # epochs of the adaptive scaling's window
GAMMA_LIMITS = (0.5, 2.0)  # paper, Sec. III-E
NIS_MEMORY = (0.6, 0.9)  # weights of the past in the fast and the slow NIS average
CORRECTION_MEMORY = 0.8
PREFERENCE_MEMORY = (0.6, 0.85)  # weights of the past in averages of log-likelihood differences
PREFERENCE_LIMIT = 30.0
PLAUSIBLE = 0.999  # chi-square quantile up to which NIS counts where modes are compared
SNR_MEMORY = 0.95
SPREAD_MEMORY = 0.8
SNR_UNSEEN_DB = -100.0  # slow mean of a link that was never seen
BLOCKAGE_ONSET_DB, BLOCKAGE_SLOPE_DB, BLOCKAGE_DEPTH, BLOCKAGE_GAIN = 6.0, 6.0, 3.0, 3.0
VERTICAL = (2, 5)  # z and vz, which flat terrain pins

Predictor = Callable[[Mode, Vector, Matrix, ProcessNoise, Number], tuple[list[Number], Matrix]]


class Memory(NamedTuple):
    """How the measurements of a track behaved so far.

    Attributes:
        mode: number of the mode that ran last.
        lockout: epochs in a row in which every visible link failed its gate.
        window: (WINDOW,) latest NIS / dof of what was accepted.
        gamma: adaptive scale of Q and R.
        nis, accepted, rejected: (groups,) of the last epoch; neither where missing.
        nis_average: (2,) fast and slow average of NIS / dof.
        correction: (2,) average correction of the position along and across the velocity, m.
        unfixed_s: seconds since a link was last accepted.
        snr_mean_db: (L,) slow mean SNR per link.
        spread_average_hz: slow average of the Doppler spread.
        preference: (2, modes) fast and slow average of each mode's :func:`plausibility` minus
            the last mode's.
    """

    mode: Number
    lockout: Number
    window: list[Number]
    gamma: Number
    nis: list[Number]
    accepted: list[Number]
    rejected: list[Number]
    nis_average: list[Number]
    correction: list[Number]
    unfixed_s: Number
    snr_mean_db: list[Number]
    spread_average_hz: Number
    preference: list[list[Number]]


class Candidate(NamedTuple):
    """What a mode makes of an epoch.

    Attributes:
        x: (7,) posterior mean.
        P: (28,) packed posterior covariance.
        P_predicted: (28,) packed covariance before the update (for smoothing).
        nis, accepted: (groups,) as in :class:`~mmwave_env.filters.update.Posterior`.
        passed: how many links passed their gates, forced ones not counted.
        log_likelihood: of the visible groups.
    """

    x: list[Number]
    P: list[Number]
    P_predicted: list[Number]
    nis: list[Number]
    accepted: list[Number]
    passed: Number
    log_likelihood: Number


def _linear_prediction(
    mode: Mode, x: Vector, P: Matrix, noise: ProcessNoise, dt: Number
) -> tuple[list[Number], Matrix]:
    """The Kalman prediction, exact for every algorithm because the motion is linear."""
    return move(x, dt), predict_covariance(P, noise, dt)


def _own_update(mode: Mode) -> Algorithm:
    return mode.update


@dataclass(frozen=True)
class Pipeline:
    """What is fixed when a track starts.

    Attributes:
        modes: the modes to choose from.
        layout: rows of the measurement vector.
        planar: flat terrain: z and vz stay at their prior values (paper, Sec. II-A). Sigma
            points keep the spacing of seven state components.
        predict, update: the filter at work; replaced by the filterpy twin.

    Raises:
        AlgorithmError: a mode's own algorithm cannot run, on lanes or at all; the message
            names the line and says what to write instead.
    """

    modes: tuple[Mode, ...]
    layout: Layout
    planar: bool = False
    predict: Predictor = _linear_prediction
    update: Callable[[Mode], Algorithm] = _own_update

    def __post_init__(self) -> None:
        for mode in self.modes:
            rehearse(mode, self.layout, self.pinned)

    @property
    def pinned(self) -> tuple[int, ...]:
        """State components that are known exactly."""
        return VERTICAL if self.planar else ()

    @property
    def position_axes(self) -> tuple[int, ...]:
        """Position components that are estimated: 3, or 2 on flat terrain."""
        return (0, 1) if self.planar else (0, 1, 2)


def start(pipeline: Pipeline) -> Memory:
    """The memory of a track that has seen nothing."""
    groups, anchors = len(pipeline.layout.groups), pipeline.layout.anchors
    return Memory(
        mode=0.0,
        lockout=0.0,
        window=[1.0] * WINDOW,
        gamma=1.0,
        nis=[0.0] * groups,
        accepted=[0.0] * groups,
        rejected=[0.0] * groups,
        nis_average=[1.0, 1.0],
        correction=[0.0, 0.0],
        unfixed_s=0.0,
        snr_mean_db=[SNR_UNSEEN_DB] * anchors,
        spread_average_hz=0.0,
        preference=[[0.0] * len(pipeline.modes) for _ in PREFERENCE_MEMORY],
    )


def process_noise(
    tuning: Tuning, epoch: Epoch, hz_per_mps: Number, gamma: Number, planar: bool
) -> ProcessNoise:
    """Q of an epoch: the tuning, Doppler-adaptive and scaled by gamma."""
    t = tuning
    velocity = t.sigma_v * t.sigma_v + t.spread_gain * epoch.doppler_spread_hz
    position = t.sigma_p * t.sigma_p
    drift = t.sigma_b_mps * hz_per_mps
    vertical = (0.0, 0.0) if planar else (t.sigma_pz * t.sigma_pz, t.sigma_vz * t.sigma_vz)
    return white_noise_acceleration(
        [gamma * v for v in (position, position, vertical[0])],
        [gamma * v for v in (velocity, velocity, vertical[1])],
        gamma * (drift * drift),
        epoch.dt,
        t.coupling,
    )


def _blockage(snr_db: Number, mean_db: Number) -> Number:
    """Factor on the noise variance of a link whose SNR fell below its slow mean."""
    depth = clip(
        (mean_db - snr_db - BLOCKAGE_ONSET_DB) * (1.0 / BLOCKAGE_SLOPE_DB), 0.0, BLOCKAGE_DEPTH
    )
    return 1.0 + BLOCKAGE_GAIN * depth


def measurement_of(
    mode: Mode, memory: Memory, epoch: Epoch, site: Site, layout: Layout
) -> Measurement:
    """The epoch's measurement with the noise that the mode believes in."""
    gamma = memory.gamma if mode.adaptive else 1.0
    variance = [gamma * (s * s) for s in epoch.sigma]
    if mode.blockage_aware:
        for link in range(layout.anchors):
            factor = _blockage(epoch.snr_db[link], memory.snr_mean_db[link])
            rows = layout.link(link)
            variance[rows] = [v * factor for v in variance[rows]]
    return Measurement(site.anchors, site.hz_per_mps, epoch.z, variance, epoch.visible, layout)


def consider(
    pipeline: Pipeline,
    mode: Mode,
    x: Vector,
    P: Vector,
    memory: Memory,
    epoch: Epoch,
    site: Site,
    tuning: Tuning | None = None,
) -> Candidate:
    """Run one mode on the coming epoch.

    Args:
        pipeline, mode: what to run.
        x: (7,) mean after the epoch before (in the first epoch: the prior).
        P: (28,) its packed covariance.
        memory: of the track.
        epoch: the coming epoch.
        site: anchors and carrier.
        tuning: process noise in place of the mode's own.
    """
    gamma = memory.gamma if mode.adaptive else 1.0
    noise = process_noise(tuning or mode.tuning, epoch, site.hz_per_mps, gamma, pipeline.planar)
    x_predicted, P_predicted = pipeline.predict(
        mode, x, unpack(P, zero=pipeline.pinned), noise, epoch.dt
    )
    x_predicted = [x[i] if i in pipeline.pinned else v for i, v in enumerate(x_predicted)]
    if mode.widen_p or mode.widen_v:
        p, v = mode.widen_p**2, mode.widen_v**2
        extra = (p, p, 0.0, v, v, 0.0, 0.0)
        P_predicted = [
            [value + extra[i] if i == j else value for j, value in enumerate(row)]
            for i, row in enumerate(P_predicted)
        ]
    force = 0.0
    if mode.recovery is not None:
        force = where(memory.lockout > mode.recovery - 0.5, 1.0, 0.0)
    measurement = measurement_of(mode, memory, epoch, site, pipeline.layout)
    gate = Gate(mode.gate, force, mode.robust)
    after = pipeline.update(mode)(x_predicted, P_predicted, measurement, gate)
    return Candidate(
        x=after.x,
        P=pack(after.P),
        P_predicted=pack(P_predicted),
        nis=after.nis,
        accepted=after.accepted,
        passed=_passed(mode, after, pipeline.layout),
        log_likelihood=after.log_likelihood,
    )


def _passed(mode: Mode, after: Posterior, layout: Layout) -> Number:
    """How many links the mode would have accepted without being forced to."""
    links = after.accepted[: layout.anchors]
    if mode.robust:
        return dot([1.0] * len(links), links)
    rows = [group.stop - group.start for group in layout.groups]
    within = [passes(q, k, mode.gate) for q, k in zip(after.nis, rows, strict=True)]
    return dot(within, links)


def limited_likelihood(candidate: Candidate, limits: Vector) -> Number:
    """Log-likelihood in which the NIS of a group (groups,) counts up to its limit.

    The tail of a Gaussian falls so fast that a single link off the line of sight would decide
    which mode is right, for the one that believes the outlier.
    """
    excess = [maximum(nis - limit, 0.0) for nis, limit in zip(candidate.nis, limits, strict=True)]
    return candidate.log_likelihood + 0.5 * dot(excess, [1.0] * len(excess))


def plausibility(candidate: Candidate, layout: Layout) -> Number:
    """The log-likelihood that modes are compared by, limited at :data:`PLAUSIBLE`."""
    rows = [group.stop - group.start for group in layout.groups]
    return limited_likelihood(candidate, [float(chdtri(k, 1.0 - PLAUSIBLE)) for k in rows])


def anticipate(
    memory: Memory, candidates: Sequence[Candidate], epoch: Epoch, layout: Layout
) -> Memory:
    """Remember what the coming epoch shows before any mode is chosen."""
    snr = [
        where(
            seen > 0.5,
            where(mean < SNR_UNSEEN_DB + 1.0, now, SNR_MEMORY * mean + (1.0 - SNR_MEMORY) * now),
            mean,
        )
        for seen, now, mean in zip(epoch.visible, epoch.snr_db, memory.snr_mean_db, strict=False)
    ]
    likelihoods = [plausibility(candidate, layout) for candidate in candidates]
    preference = []
    for past, keep in zip(memory.preference, PREFERENCE_MEMORY, strict=True):
        row = []
        for old, likelihood in zip(past, likelihoods, strict=True):
            now = clip(likelihood - likelihoods[-1], -PREFERENCE_LIMIT, PREFERENCE_LIMIT)
            row.append(keep * old + (1.0 - keep) * now)
        preference.append(row)
    spread = SPREAD_MEMORY * memory.spread_average_hz
    spread = spread + (1.0 - SPREAD_MEMORY) * epoch.doppler_spread_hz
    return memory._replace(snr_mean_db=snr, spread_average_hz=spread, preference=preference)


def commit(
    pipeline: Pipeline,
    mode: Number,
    before: Vector,
    chosen: Candidate,
    memory: Memory,
    dt: Number,
    visible: Vector,
) -> Memory:
    """The memory after a candidate has become the belief.

    Args:
        pipeline: what runs.
        mode: number of the chosen mode.
        before: (7,) mean before the epoch, unpredicted.
        chosen: the candidate.
        memory: as :func:`anticipate` left it.
        dt: the epoch's step, seconds.
        visible: (groups,) the epoch's.
    """
    layout = pipeline.layout
    dof = [float(rows.stop - rows.start) for rows in layout.groups]
    accepted_dof = dot(chosen.accepted, dof)
    some = accepted_dof > 0.5
    ratio = dot(chosen.accepted, chosen.nis) / where(some, accepted_dof, 1.0)
    window = [
        where(some, new, old)
        for new, old in zip([ratio, *memory.window[:-1]], memory.window, strict=True)
    ]
    each_link = [1.0] * layout.anchors
    seen, fixes = dot(each_link, visible), dot(each_link, chosen.accepted)
    # A forced update does not end a lock-out: one position, reached with a wrong velocity, is
    # no track. Links stay accepted until one of them passes its gate again.
    lockout = where(seen > 0.5, memory.lockout + 1.0, memory.lockout)
    predicted = move(before, dt)
    step = [chosen.x[i] - predicted[i] for i in range(2)]
    v = predicted[3:5]
    speed = sqrt(v[0] * v[0] + v[1] * v[1] + 1e-6)
    ahead = [v[i] / speed for i in range(2)]
    correction = (dot(step, ahead), step[1] * ahead[0] - step[0] * ahead[1])
    return memory._replace(
        mode=mode,
        lockout=where(chosen.passed > 0.5, 0.0, lockout),
        window=window,
        gamma=clip(dot(window, [1.0 / WINDOW] * WINDOW), *GAMMA_LIMITS),
        nis=chosen.nis,
        accepted=chosen.accepted,
        rejected=[v - a for v, a in zip(visible, chosen.accepted, strict=True)],
        nis_average=[
            where(some, keep * old + (1.0 - keep) * ratio, old)
            for old, keep in zip(memory.nis_average, NIS_MEMORY, strict=True)
        ],
        correction=[
            CORRECTION_MEMORY * old + (1.0 - CORRECTION_MEMORY) * new
            for old, new in zip(memory.correction, correction, strict=True)
        ],
        unfixed_s=where(fixes > 0.5, 0.0, memory.unfixed_s + dt),
    )
