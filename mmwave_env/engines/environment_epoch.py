"""A step of an environment whose modes share a belief or each keep their own belief.

A step takes the result of the chosen mode as the new belief (mean and covariance), scores the
belief against the truth, and runs every mode on the next epoch. Modes run before the next action is
chosen, because the observation shows the results of all modes. No action changes the world.

If the modes share a belief, their results are *candidates*, and the action chooses one. If every
mode keeps its own belief, the modes interact as in an IMM (:mod:`mmwave_env.filters.imm`), and an
action is the mode to trust in the epoch that was just filtered: the probability of that mode is
raised before the beliefs are combined, scored and mixed again. Action 0 raises no probability, so
the IMM itself decides. With ``action="weights"``, the action scales every mode's probability. With
``action="correction"``, an action corrects the belief of the second-to-last filtered epoch, and the
step scores the corrected belief. The filters continue without corrections.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

from mmwave_env.compiler.program import Program
from mmwave_env.engines.epoch_state import (
    PendingEpoch,
    blank_environment,
    initial_belief,
    last_of,
    pending_of,
    scores,
    with_expected_spread,
)
from mmwave_env.engines.track_engine import untuned
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import corrected
from mmwave_env.filters.imm import (
    ImmSettings,
    Mixture,
    begin,
    estimate,
    imm_epoch,
    most_probable_memory,
    reweighted,
    trusting,
)
from mmwave_env.filters.memory import Memory, memory_after, memory_before
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.filters.update import ModeResult
from mmwave_env.interface.actions import CORRECTION, MODE, WEIGHTS, limits_of
from mmwave_env.interface.features import MixtureView, View
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import Reward, terms_of, total
from mmwave_env.models.measurement import Site
from mmwave_env.numerics.linalg import pack, unpack
from mmwave_env.numerics.numbers import Number, where
from mmwave_env.numerics.pytree import select, tree_at
from mmwave_env.world.episode import Incoming

SPREAD_MEMORIES = (0.6, 0.9, 0.97)  # weights of the past in averages of the Doppler spread


class EnvState(NamedTuple):
    """The state of an environment between two epochs."""

    incoming: Incoming  # the epoch that this step filters
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior instead of taking the action
    action: Number  # number of the mode whose candidate becomes the belief
    pending: PendingEpoch  # the epoch whose candidates wait for an action
    # x, P: (7,), (28,) belief after the last epoch in which an action was taken
    x: list[Number]
    P: list[Number]
    memory: Memory  # memory of the track
    candidates: list[ModeResult]  # the modes' results, without predicted beliefs (to save memory)
    observation: list[Number]  # (features,)
    reward: Number  # reward of the last epoch in which an action was taken
    reward_terms: list[Number]  # terms of the reward, then the negative cost of the mode
    # truth: (6,) truth in the epoch of the reward; before any action, truth in the first epoch
    truth: list[Number]
    error: list[Number]  # (3,) position error in the epoch of the reward, m
    distance: Number  # length of the error, m
    nees: Number  # NEES in the epoch of the reward


def shared_epoch(
    w: EnvState, pipeline: Pipeline, observation: Observation, reward: Reward
) -> EnvState:
    """Compute a step of an environment whose modes share a belief."""
    layout = pipeline.layout
    modes = pipeline.modes
    chosen: ModeResult = tree_at(w.action, w.candidates)
    cost: Number = tree_at(w.action, [mode.cost for mode in modes])
    dt, visible, truth, measured, _ = w.pending
    memory = memory_after(layout, w.action, w.x, chosen, w.memory, dt, visible, measured)
    belief = pipeline.belief(chosen.x, chosen.P)

    x, P, memory = initial_belief(w, chosen.x, chosen.P, memory, pipeline)
    coming = w.incoming.epoch(layout)
    candidates = [predict_update(pipeline, m, x, P, memory, coming, w.site) for m in modes]
    coming = with_expected_spread(coming, x[3:6], w.site)
    memory = memory_before(memory, candidates, coming, layout)
    last = last_of(w, layout)
    covariance = unpack(P, zero=pipeline.known_axes)
    view = View(x, covariance, memory, candidates, coming, w.site, None, last)
    return w._replace(
        is_first=0.0,
        pending=pending_of(w.incoming, coming, observation),
        x=x,
        P=P,
        memory=memory,
        candidates=[result._replace(x_predicted=[], P_predicted=[]) for result in candidates],
        observation=observation.values(view),
        truth=select(w.is_first > 0.5, w.incoming.truth, truth),
        **scores(belief, truth, reward, cost),
    )


class Reported(NamedTuple):
    """The epoch that an action corrected. Its fields are the same as in :class:`PerModeState`."""

    x: list[Number]
    P: list[Number]
    truth: list[Number]
    memory: Memory
    mode_probabilities: list[Number]
    reward: Number  # reward of the belief before the correction, without any cost


class PerModeState(NamedTuple):
    """The state between two epochs of an environment in which every mode keeps its own belief."""

    incoming: Incoming  # the epoch that this step filters
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior instead of taking the action
    action: Number  # number of the mode to trust (modes are counted from 1); 0 for none
    numbers: list[Number]  # (k,) the action if it is weights or a correction; else empty
    settings: ImmSettings  # parameters of the bank
    pending: PendingEpoch  # the epoch whose mixture waits for an action
    mixture: Mixture  # beliefs of all modes after the pending epoch
    spread_averages_hz: list[Number]  # average Doppler spread, for each of SPREAD_MEMORIES
    # all fields below, except the observation, belong to the last epoch with an action:
    mode_probabilities: list[Number]  # (modes,) probabilities after the action
    x: list[Number]  # (7,) mean of the combined belief
    P: list[Number]  # (28,) its covariance, packed
    memory: Memory  # the most probable mode's memory; its field ``preference`` covers all modes
    observation: list[Number]  # (features,)
    # the fields from ``reward`` to ``nees`` are the same as in :class:`EnvState`
    reward: Number
    reward_terms: list[Number]
    truth: list[Number]
    error: list[Number]
    distance: Number
    nees: Number
    reported: Reported | tuple[()]  # the corrected epoch, if actions are corrections


def per_mode_epoch(
    w: PerModeState, pipeline: Pipeline, observation: Observation, reward: Reward, action: str
) -> PerModeState:
    """Compute a step of an environment in which every mode keeps its own belief."""
    dt, _, truth, *_ = w.pending
    layout = pipeline.layout
    costs = [0.0, *(mode.cost for mode in pipeline.modes)]
    if action == WEIGHTS:
        mixture = reweighted(w.mixture, w.numbers, dt)
    else:
        mixture = trusting(w.mixture, w.action, dt)
    x, covariance = estimate(mixture)
    belief = Belief(x, covariance, pipeline.position_axes)
    reported: Reported | tuple[()] = ()
    scored = truth
    if action == CORRECTION:
        scored = w.truth
        before = pipeline.belief(w.x, w.P)
        belief = corrected(before, w.numbers[:3], w.numbers[3:])
        earned = total(terms_of(reward, before, scored))
        reported = Reported(
            belief.x, pack(belief.P), scored, w.memory, w.mode_probabilities, earned
        )
    memory = most_probable_memory(mixture)._replace(preference=w.memory.preference)

    is_first = w.is_first > 0.5
    prior = begin(pipeline, w.site.prior_x, w.site.prior_P)
    x, P, memory = initial_belief(w, x, pack(covariance), memory, pipeline)
    mixture = select(is_first, prior, mixture)
    probabilities = mixture.probability
    coming = w.incoming.epoch(layout)
    mixture, predicted, _, results = imm_epoch(pipeline, w.settings, mixture, coming, w.site)
    coming = with_expected_spread(coming, x[3:6], w.site)
    memory = memory_before(memory, results, coming, layout)
    spread = coming.doppler_spread_hz
    averages = [
        where(is_first, spread, keep * old + (1.0 - keep) * spread)
        for old, keep in zip(w.spread_averages_hz, SPREAD_MEMORIES, strict=True)
    ]
    shown = MixtureView(predicted, mixture.probability, averages)
    last = last_of(w, layout, probabilities)
    covariance = unpack(P, zero=pipeline.known_axes)
    view = View(x, covariance, memory, results, coming, w.site, shown, last)
    return w._replace(
        is_first=0.0,
        pending=pending_of(w.incoming, coming, observation),
        mixture=mixture,
        spread_averages_hz=averages,
        mode_probabilities=probabilities,
        x=x,
        P=P,
        memory=memory,
        observation=observation.values(view),
        truth=select(is_first, w.incoming.truth, truth),
        reported=reported,
        **scores(belief, scored, reward, 0.0 if reported else tree_at(w.action, costs)),
    )


@lru_cache(maxsize=32)
def program_of(
    pipeline: Pipeline, kind: str, reward: Reward, per_mode: bool, action: str = MODE
) -> Program[Any]:
    """Return the program of an epoch, shared by all environments with the same arguments.

    Args:
        pipeline: modes and layout; with ``per_mode``, tunings come from the state, not the modes.
        kind: kind of observation.
        reward: function of (belief, truth).
        per_mode: whether every mode keeps its own belief.
        action: kind of actions (:mod:`mmwave_env.interface.actions`).
    """
    if per_mode:
        pipeline = untuned(pipeline)
    observation = Observation(pipeline, kind, "per-mode" if per_mode else "shared")
    layout = pipeline.layout
    modes = len(pipeline.modes)
    blank = blank_environment(layout, modes, reward, observation)
    arguments: Any = {"pipeline": pipeline, "observation": observation, "reward": reward}
    if per_mode:
        even = [1.0 / modes] * modes
        reported = Reported(blank["x"], blank["P"], blank["truth"], blank["memory"], even, 0.0)
        template = PerModeState(
            numbers=[0.0] * len(limits_of(action, modes)),
            settings=settings_of(Bank(pipeline.modes), layout),
            mixture=begin(pipeline, blank["x"], blank["P"]),
            spread_averages_hz=[0.0] * len(SPREAD_MEMORIES),
            mode_probabilities=even,
            reported=reported if action == CORRECTION else (),
            **blank,
        )
        return Program(partial(per_mode_epoch, action=action, **arguments), template)
    groups = [0.0] * len(layout.groups)
    candidate = ModeResult(blank["x"], blank["P"], [], [], groups, groups, 0.0, 0.0)
    start = EnvState(candidates=[candidate] * modes, **blank)
    return Program(partial(shared_epoch, **arguments), start)
