"""Episodes for a corrector to learn from: features, and the errors and beliefs of its base.

The *base* is the policy or IMM whose beliefs are corrected. Some episodes are at the places of the
training (scenes with a radio). In the other episodes, the streets, carrier, radio, rate of epochs,
clock, measured quantities and anchors are random, and the receiver may err in its noise and
orientation. Without random episodes, a network memorizes the places.

Some episodes have errors that all links share, such as a turned frame. They correct heights that
the prior of simulated episodes knows well, so a network would learn to trust first heights, which
a log's first fix does not justify. So half of the episodes begin as a log does: from a link.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from experiments.training.training_task import Place
from mmwave_env.engines.engine import Engine, play
from mmwave_env.engines.smoothing import GATES, smoothed_features
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import deviations_of
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.interface.signed import after_update
from mmwave_env.localization.starts import gives_fix
from mmwave_env.models.prior import prior_from_fix
from mmwave_env.models.radio import radio_from, random_radio
from mmwave_env.models.random_scene import WIDE_SCENE, RandomSurvey
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array, Array32
from mmwave_env.world.episode import EpisodeBatch, columns_of, site_index
from mmwave_env.world.keys import keys_at, stream_of
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.trajectory import Trajectory, Ways
from policies.corrector import base_policy

# times between epochs to draw from, s
STEPS_S = (1.0, 1.0, 1.0, 1.0, 1.0, 0.5, 0.25, 0.1, 0.1, 0.1, 2.0)
EPOCHS = 200  # number of epochs of an episode, unless it is a long one
SUBSETS = (  # a receiver that lacks quantities measures only the quantities of one row
    ("range", "azimuth", "elevation", "departure"),
    ("range", "azimuth", "elevation"),
    ("range", "azimuth", "elevation", "doppler"),
    ("azimuth", "elevation", "departure"),
    ("azimuth", "elevation", "departure", "doppler"),
    ("range", "azimuth", "departure"),
    ("range", "azimuth"),
)
# Probabilities that a random receiver lacks quantities, has a clock with an offset or a free one,
# misjudges its noise, measures only some anchors, or does not know its orientation exactly.
LACKING = 0.3
DRIFTING = 0.15
FREE = 0.05
MISJUDGING = 0.3
FEWER = 0.15
TURNED = 0.15
ORIENTATION_RAD = 0.1  # standard deviation of an orientation that is not known exactly
FROM_A_LINK = 0.5  # probability that the episodes of a batch begin from a link, as those of logs do
# Probability that links of a random receiver are never blocked, disturbed by multipath, or lost.
# With too few such receivers, a network overestimates the errors at quiet places.
CLEAR = 0.3
# Probability that the users of a batch of random episodes weave from side to side and vary their
# speed, as real users do. Others keep to the middle of the street; a network must not rely on this.
WEAVING = 0.5
WAYS = 64  # maximum number of weaving trajectories from which the episodes of one Lot are drawn
WEAVE_S = (8.0, 40.0)  # limits of the period of weaving when a user moves at top speed, s
# per axis: limits of (weaving velocity : speed), and offset, m
WEAVE_SLOPE = 0.3
WEAVE_M = 2.5
WEAVING_BEHIND_M = (20.0, 60.0)  # range of distances from streets to walls, if users weave, m


class Surveys(NamedTuple):
    """Surveys with errors in a training: how frequent they are, and how bad."""

    at_places: float  # probability at the places of the training, for all episodes of a lot
    at_random: float  # probability in random streets
    survey: RandomSurvey
    worse: RandomSurvey
    worse_share: float  # share of the worse survey among surveys with errors


# three of four episodes of a survey with errors have one or more of them
BAD = RandomSurvey(rate=0.2)
BAD_SURVEYS = Surveys(
    at_places=0.13,
    at_random=0.4,
    survey=BAD,
    worse=replace(
        BAD,
        rotation_rad=2.5 * BAD.rotation_rad,
        tilt_rad=2.5 * BAD.tilt_rad,
        range_m=3.0 * BAD.range_m,
        anchors_m=2.0 * BAD.anchors_m,
        heights_m=1.5 * BAD.heights_m,
        slow=2.0 * BAD.slow,
    ),
    worse_share=0.3,
)


@dataclass
class TrainingEpisodes:
    """A source of batches of episodes, in which no episode occurs twice.

    Attributes:
        scenario, places: kind of user, and places of the training.
        seed: seed from which all episodes and all random choices follow.
        n: number of episodes in a batch; long episodes are fewer.
        random_share: share of batches with random streets, radio and receiver.
        long_epochs: length of long episodes, epochs.
        surveys: errors of surveys.
        drawn: number of episodes drawn so far; :meth:`batches` goes on with the next ones.
    """

    scenario: str
    places: Sequence[Place]
    seed: int
    n: int
    random_share: float
    long_epochs: int
    surveys: Surveys = BAD_SURVEYS
    drawn: int = 0

    def batches(self, rounds: int) -> Iterator[tuple[str, EpisodeBatch]]:
        """Yield batches, each with the name of its radio profile.

        A round has a batch for every place, then random batches.
        """
        surveys = self.surveys
        count = round(len(self.places) * self.random_share / (1.0 - self.random_share))
        for place in [*self.places, *[None] * count] * rounds:
            rng = np.random.default_rng((self.seed, self.drawn))
            if place is None:
                profile, source = self._at_random(rng)
            else:
                profile = place.profile
                source = place.source(self.scenario)
            if place and place.dt == 1.0:
                source = self._at_some_rate(source, rng)
            erring = rng.random() < (surveys.at_places if place else surveys.at_random)
            survey = surveys.worse if rng.random() < surveys.worse_share else surveys.survey
            if erring:
                source = replace(source, survey=survey)
            batch = self._draw(source)
            if place is None:
                degrade(batch, rng)
            if rng.random() < FROM_A_LINK:
                begin_from_a_link(batch, source)
            yield profile, batch

    def _at_random(self, rng: np.random.Generator) -> tuple[str, SimulatedSource]:
        """Return the radio of a random receiver, and its source of episodes in random streets."""
        places = {place.profile: place for place in self.places}
        profile = str(rng.choice(list(places)))
        scene = replace(
            WIDE_SCENE,
            carrier_hz=float(rng.uniform(24e9, 60e9)),
            bandwidth_hz=float(rng.choice([100e6, 200e6, 400e6])),
        )
        radio = random_radio(radio_from(places[profile].radio), rng)
        if rng.random() < CLEAR:
            radio = replace(radio, blockage_scale=0.0, multipath_rate_hz=0.0, outage_rate_hz=0.0)
        lacks = rng.random() < LACKING
        drifts = rng.random()
        subset = SUBSETS[rng.integers(len(SUBSETS))] if lacks else None
        clock = "synchronized"
        if drifts < DRIFTING + FREE and (subset is None or "range" in subset):
            clock = "offset" if drifts < DRIFTING else "free"
        source = SimulatedSource(scene, radio, self.scenario, measurements=subset, clock=clock)
        source = self._at_some_rate(source, rng)
        if rng.random() < WEAVING:
            source = weaving(replace(source, scene=replace(scene, behind_m=WEAVING_BEHIND_M)), rng)
        return profile, source

    def _at_some_rate(self, source: SimulatedSource, rng: np.random.Generator) -> SimulatedSource:
        """Return a source with a random time between epochs.

        If this time is at most 0.2 s, half of the batches have long episodes.
        """
        dt = float(rng.choice(STEPS_S))
        long = rng.random() < 0.5
        return replace(source, dt=dt, epochs=self.long_epochs if dt <= 0.2 and long else EPOCHS)

    def _draw(self, source: SimulatedSource) -> EpisodeBatch:
        """Draw ``n`` new episodes, or fewer if they are longer than EPOCHS."""
        n = max(1, self.n * EPOCHS // max(source.epochs, EPOCHS))
        stream = np.array([stream_of(self.seed)], np.uint64)
        keys = keys_at(stream, np.arange(self.drawn, self.drawn + n, dtype=np.uint64))
        self.drawn += n
        return source.sample_batch(keys)


def begin_from_a_link(batch: EpisodeBatch, source: SimulatedSource) -> None:
    """Compute the priors of a batch as for a log: from a whole link of the first epoch.

    Filters must not use the link again, so it is then missing. Episodes without such a link keep
    their prior, and so do all if the clock is not synchronized.
    """
    layout = batch.layout
    if layout.has_bias:
        return
    at = columns_of(layout)
    index = site_index(layout)
    lower = np.tril_indices(layout.state_size)
    for table, site in zip(batch.table[:, 0], batch.site, strict=True):
        anchors = site[index.anchors]
        for anchor, position in enumerate(anchors):
            link = table[at.z][layout.link(anchor)]
            columns = at.signed_sigma[layout.link(anchor)]
            sigma = table[columns]
            if (sigma > 0.0).all() and gives_fix(link[None])[0]:
                mean, covariance = prior_from_fix(
                    position, link, sigma, source.radio, source.example
                )
                site[index.prior_x] = mean
                site[index.prior_P] = covariance[lower]
                table[columns] = -sigma
                break


def weaving(source: SimulatedSource, rng: np.random.Generator) -> SimulatedSource:
    """Draw a scene from a source with random scenes; return a source of users who weave in it.

    A weaving user's position is a simulated user's position plus, along each street axis, a sine of
    the distance traveled. So weaving users stand still when the simulated users do.
    """
    source = replace(source, scene=source.scene_of(int(rng.integers(2**63))))
    batch = source.sample_batch(rng.integers(2**63, size=WAYS, dtype=np.uint64))
    truth = batch.table[:, :, columns_of(batch.layout).truth]
    truth = truth[np.ptp(truth[:, :, :2], axis=1).max(axis=1) > WEAVE_M]
    speed = np.linalg.norm(truth[:, :, 3:], axis=2, keepdims=True)
    fastest = speed.max(axis=1, keepdims=True)
    shape = (len(truth), 1, 2)
    radian = fastest * rng.uniform(*WEAVE_S, shape) / (2.0 * np.pi)  # distance per radian, m
    slope = np.minimum(rng.uniform(0.0, WEAVE_SLOPE, shape), WEAVE_M / radian)
    angle = np.cumsum(speed, axis=1) * source.dt / radian + rng.uniform(0.0, 2.0 * np.pi, shape)
    truth[:, :, :2] += slope * radian * np.sin(angle)
    truth[:, :, 3:5] += slope * np.cos(angle) * speed
    ways = [Trajectory("weaving", source.time_s, way[:, :3], way[:, 3:]) for way in truth]
    return replace(source, scenario=Ways("weaving", ways))


def degrade(batch: EpisodeBatch, rng: np.random.Generator) -> None:
    """Make the receiver, at random, misjudge noise or orientation, or miss some anchors."""
    at = columns_of(batch.layout)
    layout = batch.layout
    sigma = batch.table[:, :, at.signed_sigma]
    if rng.random() < MISJUDGING:
        sigma *= 2.0 ** rng.uniform(-1.0, 1.0, (len(sigma), 1, 1))
    if layout.anchors > 1 and rng.random() < FEWER:
        first = layout.link(int(rng.integers(1, layout.anchors))).start
        links = sigma[:, :, first : layout.doppler]
        np.negative(np.abs(links), out=links)
    batch.table[:, :, at.signed_sigma] = sigma
    if rng.random() < TURNED:
        azimuths = at.z[1 : layout.doppler : 4]
        batch.table[:, :, azimuths] += rng.normal(0.0, ORIENTATION_RAD, (len(sigma), 1, 1))


class Beliefs(NamedTuple):
    """Beliefs about n tracks of T epochs each, and what a corrector sees of them.

    Attributes:
        features: (n, T, features) features for the network.
        x, P: (n, T, 7) means and (n, T, 28) packed covariances.
        error: (n, T, 3) estimate minus truth, m.
    """

    features: Array32
    x: Array
    P: Array
    error: Array


def _played(batch: EpisodeBatch, bank: Bank, base: str, *names: str) -> dict[str, Any]:
    """Play episodes with the policy ``base``; record parts of the state, and features after it."""
    n, epochs, _ = batch.table.shape
    pipeline = Pipeline(bank.modes, batch.layout)
    engine = Engine(pipeline, n, TrackingReward(), "signed", bank, action=CORRECTION)
    engine.load(batch)
    after = [feature.name for feature in after_update(pipeline)]
    columns = np.array([engine.observation.names.index(name) for name in after])
    return play(engine, base_policy(base, engine.observation), epochs, names, columns)


def filtered(batch: EpisodeBatch, bank: Bank, base: str) -> Beliefs:
    """Filter episodes with the policy ``base`` and a bank."""
    track = _played(batch, bank, base, "x", "P", "error")
    return Beliefs(track["features"], track["x"], track["P"], track["error"])


def smoothed(batch: EpisodeBatch, bank: Bank, base: str) -> Beliefs:
    """Filter episodes with the policy ``base`` and a bank, and smooth the tracks."""
    gates = [f"memory.{gate}" for gate in GATES]
    parts = _played(batch, bank, base, "x", "error", "mixture", *gates)
    pipeline = Pipeline(bank.modes, batch.layout)
    at = columns_of(batch.layout)
    hz_per_mps = float(batch.site[0, site_index(batch.layout).hz_per_mps])
    dt = batch.table[:, :, at.dt]
    spread_hz = batch.table[:, :, at.doppler_spread_hz]
    mixture = parts["mixture"]
    x, P = smooth_modes(bank, pipeline, mixture, dt, spread_hz, hz_per_mps)
    judged = [parts[gate] for gate in gates]
    features = smoothed_features(pipeline, batch.table, batch.site, x, P, mixture, judged)
    return Beliefs(features, x, P, parts["error"] + (x - parts["x"])[..., :3])


class Lot(NamedTuple):
    """A lot, or batch: n episodes of T epochs each.

    Attributes:
        features: (T, n, features) input of a corrector after every epoch.
        error: (T, n, 3) truth minus estimate, m: along the motion, across it, and up.
        deviation: (T, n, 3) standard deviations of the belief in the same directions, m.
    """

    features: Array32
    error: Array32
    deviation: Array32


def lot_of(beliefs: Beliefs) -> Lot:
    """Return what a corrector learns from beliefs.

    Episodes in which a belief became NaN or infinite (docs/reliability.md) are left out.
    """
    x = list(np.moveaxis(beliefs.x, -1, 0))
    P = unpack(list(np.moveaxis(beliefs.P, -1, 0)))
    frame, deviations = deviations_of(Belief(x, P))
    left = -beliefs.error
    truth = [*frame.into(left[..., 0], left[..., 1]), left[..., 2]]
    rows = [np.stack(part, axis=-1).astype(np.float32) for part in (truth, deviations)]
    parts = (beliefs.features, *rows)
    sound = np.logical_and.reduce([np.isfinite(part).all(axis=(1, 2)) for part in parts])
    return Lot(*(np.swapaxes(part[sound], 0, 1) for part in parts))
