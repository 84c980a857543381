"""One epoch of a track: the program that environments, localizers and comparisons run.

A track is filtered epoch by epoch. An epoch consists of *verbs*, functions from the state of a
track to its next state:

* ``filter``: all modes run on the incoming epoch, and a policy's observation is computed;
* ``decide``: the action turns the results of the modes into the belief;
* ``refresh``: the observation's columns that describe the belief after its update are renewed;
* ``correct``: an action corrects this belief, which is then reported instead of the filters' own;
* ``score``: the belief is compared with the truth, and rewarded.

No verb changes the world, and the filters go on without corrections. :func:`program_of` compiles
verbs into one function. An environment's step is decide, score, filter, because the observation
shows the results of all modes on the coming epoch. A track without an agent is filter, decide.
Where a policy is asked in every epoch of a track, filter and decide are two functions.

If the modes share a belief, their results are *candidates*, and the action chooses one. If every
mode keeps its own belief, the modes interact as in an IMM (:mod:`mmwave_env.filters.imm`): an
action is the mode to trust, and its probability is raised before the beliefs are combined and mixed
again. Action 0 raises no probability. With ``action="weights"``, an action scales all of them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial, reduce
from typing import Any, NamedTuple

from mmwave_env.compiler.program import Program
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import corrected
from mmwave_env.filters.imm import (
    begin,
    estimate,
    imm_epoch,
    most_probable_memory,
    reweighted,
    trusting,
)
from mmwave_env.filters.memory import Memory, initial_memory, memory_after, memory_before
from mmwave_env.filters.modes import Tuning
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.filters.update import ModeResult
from mmwave_env.interface.actions import CORRECTION, MODE, WEIGHTS, limits_of
from mmwave_env.interface.features import View
from mmwave_env.interface.observation import Observation, standardized
from mmwave_env.interface.policy import Rule
from mmwave_env.interface.reward import Reward, term_names, terms_of, total
from mmwave_env.interface.signed import LastEpoch, after_update
from mmwave_env.models.measurement import Epoch, Site, blank_site
from mmwave_env.models.radio import Radio
from mmwave_env.numerics.linalg import dot, pack, unpack
from mmwave_env.numerics.numbers import Number, Numbers, Vector, blend, maximum, sqrt, where
from mmwave_env.numerics.pytree import select, tree_at
from mmwave_env.world.episode import Incoming, blank_incoming

SPREAD_MEMORIES = (0.6, 0.9, 0.97)  # weights of the past in averages of the Doppler spread


class Asked(NamedTuple):
    """The parts of an epoch that are asked for; nothing else is compiled.

    Attributes:
        pipeline: modes and layout.
        per_mode: whether every mode keeps its own belief; its tunings then come from the state.
        observation: kind of observation; "" if no policy chooses between filter and decide. The
            tunings of modes that share a belief then also come from the state.
        reward: function of (belief, truth); None to compute only errors and NEES.
        action: kind of actions (:mod:`mmwave_env.interface.actions`); "" if an IMM gets none.
        predicted: whether to keep likelihoods and, for smoothing, beliefs before their updates, if
            modes share a belief.
        rule: function that chooses the mode, given the mean before the epoch and the epoch.
    """

    pipeline: Pipeline
    per_mode: bool = False
    observation: str = ""
    reward: Reward | None = None
    action: str = MODE
    predicted: bool = False
    rule: Rule | None = None

    @property
    def table(self) -> Observation:
        """Return the table of the observed features."""
        return Observation(
            self.pipeline, self.observation, "per-mode" if self.per_mode else "shared"
        )

    @property
    def signed(self) -> bool:
        """Return whether observations contain residuals of the last epoch, as correctors need."""
        return self.observation == "signed"


class PendingEpoch(NamedTuple):
    """The parts of an epoch that are needed after the modes have run on it."""

    # dt, visible: same as in :class:`~mmwave_env.models.measurement.Epoch`
    dt: Number
    visible: Numbers
    truth: Numbers  # (6,) true position (m) and velocity (m/s)
    measured: Vector  # same as in :class:`~mmwave_env.models.measurement.Epoch`
    incoming: Any  # the complete epoch if the observation is "signed"


class Reported(NamedTuple):
    """The epoch that an action corrected. Its fields are the same as in :class:`EpochState`."""

    x: Numbers
    P: Numbers
    truth: Numbers
    memory: Memory
    mode_probabilities: Numbers
    reward: Number  # reward of the belief before the correction, without any cost


class EpochState(NamedTuple):
    """The state of a track between two verbs. Parts that are not asked for are empty."""

    incoming: Incoming  # the epoch to filter
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior
    # number of the mode to choose; with beliefs per mode: to trust, counted from 1; 0 for none
    action: Number
    numbers: Numbers  # (k,) the action if it is weights or a correction
    settings: Any  # ImmSettings of a bank, or a list with the Tuning of every mode
    # pending, candidates: the PendingEpoch that waits for an action; its results if x, P are shared
    pending: Any
    candidates: list[ModeResult]
    mixture: Any  # Mixture: beliefs of all modes, if every mode keeps its own
    spread_averages_hz: Numbers  # average Doppler spread, for each of SPREAD_MEMORIES
    # the following fields, except the observation, belong to the last decided epoch
    mode_probabilities: Numbers  # (modes,) probabilities after the action
    velocity: Numbers  # (3,) velocity before the epoch, for residuals
    x: Numbers  # (7,) mean of the belief
    P: Numbers  # (28,) its covariance, packed
    # x_predicted, P_predicted: (7,), (28,) belief before its update
    x_predicted: Numbers
    P_predicted: Numbers
    log_likelihood: Any  # a number, of the chosen candidate
    memory: Memory  # memory of the track or, with beliefs per mode, of the most probable mode
    observation: Numbers  # (features,)
    reward: Any  # a number
    reward_terms: Numbers  # terms of the reward, then the negative cost of the mode
    truth: Numbers  # (6,) truth; before any action, the truth in the first epoch
    error: Numbers  # (3,) position error, m; NaN if the truth is unknown
    distance: Any  # a number: length of the error, m
    nees: Number  # NEES of the position
    reported: Any  # Reported: the corrected epoch, if actions are corrections


def filter_epoch(w: EpochState, asked: Asked) -> EpochState:
    """Run all modes on the incoming epoch; observe their results. A first epoch has the prior."""
    pipeline = asked.pipeline
    layout = pipeline.layout
    w = _started(w, asked)
    epoch = w.incoming.epoch(layout)
    predicted: Numbers = []
    if asked.per_mode:
        mixture, predicted, results = imm_epoch(pipeline, w.settings, w.mixture, epoch, w.site)
        w = w._replace(mixture=mixture)
    else:
        if asked.rule:
            w = w._replace(action=asked.rule(w.x, epoch))
        tunings = w.settings or [None] * len(pipeline.modes)
        results = [
            predict_update(pipeline, mode, w.x, w.P, w.memory, epoch, w.site, tuning)
            for mode, tuning in zip(pipeline.modes, tunings, strict=True)
        ]
        w = w._replace(candidates=[_kept(result, asked) for result in results])
    if asked.observation:
        epoch = with_expected_spread(epoch, w.x[3:6], w.site)
    if asked.observation or not asked.per_mode:
        w = w._replace(memory=memory_before(w.memory, results, epoch, layout))
    if asked.observation and asked.per_mode:
        spread = epoch.doppler_spread_hz
        averages = [
            where(w.is_first > 0.5, spread, blend(keep, old, spread))
            for old, keep in zip(w.spread_averages_hz, SPREAD_MEMORIES, strict=True)
        ]
        w = w._replace(spread_averages_hz=averages)
    if asked.observation:
        view = _view(w, asked, epoch, results, predicted)
        w = w._replace(observation=standardized(asked.table.features, view))
    last = w.incoming if asked.signed else ()
    pending = PendingEpoch(epoch.dt, epoch.visible, w.incoming.truth, epoch.measured, last)
    return w._replace(is_first=0.0, pending=pending)


def decide(w: EpochState, asked: Asked) -> EpochState:
    """Turn the results of the modes into the belief, as the action says."""
    pending = w.pending
    if asked.signed:
        w = w._replace(velocity=w.x[3:6])
    w = w._replace(truth=pending.truth)
    if asked.per_mode:
        mixture = w.mixture
        if asked.action == WEIGHTS:
            mixture = reweighted(mixture, w.numbers, pending.dt)
        elif asked.action:
            mixture = trusting(mixture, w.action, pending.dt)
        x, P = estimate(mixture)
        memory = most_probable_memory(mixture)._replace(preference=w.memory.preference)
        w = w._replace(mixture=mixture, mode_probabilities=mixture.probability)
        return w._replace(x=x, P=P, memory=memory)
    chosen: ModeResult = tree_at(w.action, w.candidates)
    memory = memory_after(asked.pipeline.layout, w.action, w.x, chosen, w.memory, pending)
    w = w._replace(x=chosen.x, P=chosen.P, memory=memory)
    if not asked.predicted:
        return w
    return w._replace(
        x_predicted=chosen.x_predicted,
        P_predicted=chosen.P_predicted,
        log_likelihood=chosen.log_likelihood,
    )


def refresh(w: EpochState, asked: Asked) -> EpochState:
    """Renew the columns of the observation that describe the belief after its update."""
    columns = {name: i for i, name in enumerate(asked.table.names)}
    after = after_update(asked.pipeline)
    features = [feature for feature in after if feature.name in columns]
    epoch = w.incoming.epoch(asked.pipeline.layout)  # no feature here depends on it
    view = _view(w, asked, epoch, [])
    observation = list(w.observation)
    for feature, value in zip(features, standardized(features, view), strict=True):
        observation[columns[feature.name]] = value
    return w._replace(observation=observation)


def correct(w: EpochState, asked: Asked) -> EpochState:
    """Correct the belief by the state's ``numbers``, and score the corrected belief."""
    before = asked.pipeline.belief(w.x, w.P)
    belief = corrected(before, w.numbers[:3], w.numbers[3:])
    earned: Number = 0.0
    if asked.reward:
        earned = total(terms_of(asked.reward(before, w.truth)))
    report = Reported(belief.x, pack(belief.P), w.truth, w.memory, w.mode_probabilities, earned)
    return w._replace(reported=report, **_scores(belief, w.truth, asked.reward, 0.0))


def score(w: EpochState, asked: Asked) -> EpochState:
    """Score the belief against the truth; the cost of the chosen or trusted mode is subtracted."""
    costs = [mode.cost for mode in asked.pipeline.modes]
    if asked.per_mode:
        costs = [0.0, *costs]
    belief = asked.pipeline.belief(w.x, w.P)
    return w._replace(**_scores(belief, w.truth, asked.reward, tree_at(w.action, costs)))


def _scores(belief: Belief, truth: Vector, reward: Reward | None, cost: Number) -> dict[str, Any]:
    """Return the errors of a belief, its reward minus ``cost``, and the terms of the reward."""
    errors = {"error": belief.error(truth), "nees": belief.nees(truth)}
    if reward is None:
        return errors
    terms = terms_of(reward(belief, truth))
    return errors | {
        "reward": total(terms) - cost,
        "reward_terms": [*terms.values(), 0.0 - cost],
        "distance": belief.distance(truth),
    }


def _started(w: EpochState, asked: Asked) -> EpochState:
    """Return the state with which the incoming epoch begins: at first, the prior."""
    pipeline = asked.pipeline
    truth = w.incoming.truth
    x = pipeline.prior(w.site.prior_x, truth)
    P = w.site.prior_P
    memory = initial_memory(pipeline.layout, len(pipeline.modes))
    start = w._replace(x=x, P=P, memory=memory, truth=truth)
    if asked.per_mode:
        start = start._replace(mixture=begin(pipeline, x, P))
    if asked.action == CORRECTION:
        start = start._replace(reported=w.reported._replace(x=x, P=P, truth=truth))
    w = select(w.is_first > 0.5, start, w)
    return w._replace(mode_probabilities=w.mixture.probability) if asked.per_mode else w


def _kept(result: ModeResult, asked: Asked) -> ModeResult:
    """Return a candidate; its predicted belief is dropped if nobody asks, to save memory."""
    return result if asked.predicted else result._replace(x_predicted=[], P_predicted=[])


def _view(
    w: EpochState, asked: Asked, epoch: Epoch, results: list[ModeResult], predicted: Vector = ()
) -> View:
    """Return the inputs of features.

    Args:
        w: the state after the modes have run.
        asked: the parts that are asked for, perhaps the last epoch.
        epoch, results: the coming epoch, and one result per mode.
        predicted: (modes,) probabilities before the epoch, if every mode keeps its own belief.
    """
    layout = asked.pipeline.layout
    last = None
    if asked.signed:
        decided = with_expected_spread(w.pending.incoming.epoch(layout), w.velocity, w.site)
        last = LastEpoch(decided, w.is_first, w.velocity, w.mode_probabilities)
    covariance = unpack(w.P, zero=asked.pipeline.known_axes)
    posterior = w.mixture.probability if asked.per_mode else ()
    return View(
        w.x, covariance, w.memory, results, epoch, w.site, layout,
        predicted, posterior, w.spread_averages_hz, last,
    )  # fmt: skip


def with_expected_spread(epoch: Epoch, velocity: Vector, site: Site) -> Epoch:
    """Return the epoch, with an expected Doppler spread if none was measured (value 0).

    Features need this, because 0 would tell policies that the user stands still. This expectation
    approximates the mean of :func:`~mmwave_env.models.radio.doppler_spread` for the estimated
    ``velocity`` (3,), m/s, with the default parameters of a radio. Epochs without any measurement,
    such as the blank epoch after an episode's last epoch, keep the value 0.
    """
    floor_mps = Radio.spread_floor_mps * math.sqrt(2.0 / math.pi)  # mean of |N(0, floor)|
    speed_mps = sqrt(dot(velocity, velocity))
    expected = site.hz_per_mps * (Radio.spread_gain * speed_mps + floor_mps)
    spread = epoch.doppler_spread_hz
    measured = reduce(maximum, epoch.visible)
    return epoch._replace(doppler_spread_hz=where(spread > 0.0, spread, measured * expected))


Verb = Callable[[EpochState, Asked], EpochState]


@lru_cache(maxsize=64)
def program_of(asked: Asked, verbs: tuple[Verb, ...]) -> Program[EpochState]:
    """Return the program of some verbs, in order; programs of the same ``asked`` share a state."""
    return Program(partial(_run, asked=asked, verbs=verbs), _start(asked))


def _run(w: EpochState, asked: Asked, verbs: Sequence[Verb]) -> EpochState:
    after = w
    for verb in verbs:
        after = verb(after, asked)
    if not asked.observation:  # no epoch waits for an action
        after = after._replace(pending=(), candidates=[])
    return after


def _start(asked: Asked) -> EpochState:
    """Return the state of a track before its first epoch."""
    pipeline = asked.pipeline
    layout = pipeline.layout
    modes = len(pipeline.modes)
    per_mode = asked.per_mode
    agent = bool(asked.observation)  # a policy chooses between filter and decide
    predicted = asked.predicted and not per_mode
    incoming = blank_incoming(layout)
    truth = incoming.truth
    site = blank_site(layout)
    x = site.prior_x
    P = site.prior_P
    memory = initial_memory(layout, modes)
    probabilities = [1.0 / modes] * modes if per_mode else []
    groups = [0.0] * len(layout.groups)
    measured = [0.0] * layout.size if layout.partial else ()
    last = incoming if asked.signed else ()
    candidate = ModeResult(x, P, x, P, groups, groups, 0.0, 0.0)
    settings: Any = []
    if per_mode:
        settings = settings_of(Bank(pipeline.modes))
    elif not agent:
        settings = [Tuning(*[0.0] * len(Tuning._fields))] * modes
    terms = [0.0] * (len(term_names(asked.reward)) + 1) if asked.reward else []
    return EpochState(
        incoming=incoming,
        site=site,
        is_first=1.0,
        action=0.0,
        numbers=[0.0] * len(limits_of(asked.action, modes)) if agent else [],
        settings=settings,
        pending=PendingEpoch(0.0, groups, truth, measured, last) if agent else (),
        candidates=[_kept(candidate, asked)] * modes if agent and not per_mode else [],
        mixture=begin(pipeline, x, P) if per_mode else (),
        spread_averages_hz=[0.0] * len(SPREAD_MEMORIES) if agent and per_mode else [],
        mode_probabilities=probabilities,
        velocity=[0.0] * 3 if asked.signed else [],
        x=x,
        P=P,
        x_predicted=x if predicted else [],
        P_predicted=P if predicted else [],
        log_likelihood=0.0 if predicted else (),
        memory=memory,
        observation=[0.0] * len(asked.table) if agent else [],
        reward=0.0 if asked.reward else (),
        reward_terms=terms,
        truth=truth,
        error=[0.0] * 3,
        distance=0.0 if asked.reward else (),
        nees=0.0,
        reported=Reported(x, P, truth, memory, probabilities, 0.0)
        if asked.action == CORRECTION
        else (),
    )


def untuned(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline without tunings, so that modes that differ only in tuning are equal."""
    modes = []
    for i, mode in enumerate(pipeline.modes):
        tuning: dict[str, Any] = dict.fromkeys(Tuning._fields, 0.0) | {
            "coupling": False,
            "acceleration_mps2": float(mode.acceleration_mps2 != 0.0),
        }
        modes.append(replace(mode, name=str(i), **tuning))
    return replace(pipeline, modes=tuple(modes))
