"""The epoch of an environment in which every mode keeps its own belief.

The modes interact as in an IMM (:mod:`mmwave_env.filters.imm`). An action chooses the mode to
trust in the epoch that was just filtered: the probability of that mode is raised before the
beliefs are combined, scored and mixed again. Action 0, which trusts no mode, is the IMM itself.
"""

from functools import lru_cache, partial
from typing import NamedTuple

from mmwave_env.compiler.program import Program
from mmwave_env.engines.epoch_state import PendingEpoch, begun, blank_environment, scores
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.imm import (
    ImmSettings,
    Mixture,
    begin,
    estimate,
    imm_epoch,
    most_probable_memory,
    trusting,
)
from mmwave_env.filters.memory import Memory, memory_before
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.features import MixtureView, View
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import Reward
from mmwave_env.models.measurement import Site
from mmwave_env.numerics.linalg import pack, unpack
from mmwave_env.numerics.numbers import Number, where
from mmwave_env.numerics.pytree import select, tree_at
from mmwave_env.world.episode import Incoming

SPREAD_MEMORIES = (0.6, 0.9, 0.97)  # weights of the past in averages of the Doppler spread


class PerModeState(NamedTuple):
    """The state between two epochs of an environment in which every mode keeps its own belief."""

    incoming: Incoming  # the epoch under consideration
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior instead of taking the action
    action: Number  # number of the mode to trust, from 1; 0 for none
    settings: ImmSettings  # parameters of the bank
    pending: PendingEpoch  # the epoch whose mixture waits for an action
    mixture: Mixture  # belief after that epoch
    spread_averages_hz: list[Number]  # average Doppler spread, for each of SPREAD_MEMORIES
    # all further fields are those of the last epoch in which an action was taken:
    mode_probabilities: list[Number]  # (modes,) probabilities after the action
    # x, P: (7,), (28,) the combined belief
    x: list[Number]
    P: list[Number]
    memory: Memory  # memory of the most probable mode; its preferences cover all modes
    observation: list[Number]  # (features,)
    # reward to nees: as in :class:`~mmwave_env.engines.shared_epoch.EnvState`
    reward: Number
    reward_terms: list[Number]
    truth: list[Number]
    error: list[Number]
    distance: Number
    nees: Number


def epoch(
    w: PerModeState, pipeline: Pipeline, observation: Observation, reward: Reward
) -> PerModeState:
    """Compute one step of an environment, on numbers."""
    dt, _, truth = w.pending
    layout, costs = pipeline.layout, [0.0, *(mode.cost for mode in pipeline.modes)]
    mixture = trusting(w.mixture, w.action, dt)
    x, covariance = estimate(mixture)
    belief = Belief(x, covariance, pipeline.position_axes)
    probabilities = mixture.probability
    memory = most_probable_memory(mixture)._replace(preference=w.memory.preference)

    is_first, prior = w.is_first > 0.5, begin(pipeline, w.site.prior_x, w.site.prior_P)
    x, P, memory = begun(w, x, pack(covariance), memory, pipeline)
    mixture = select(is_first, prior, mixture)
    coming = w.incoming.epoch(layout)
    mixture, predicted, _, results = imm_epoch(pipeline, w.settings, mixture, coming, w.site)
    memory = memory_before(memory, results, coming, layout)
    spread = coming.doppler_spread_hz
    averages = [
        where(is_first, spread, keep * old + (1.0 - keep) * spread)
        for old, keep in zip(w.spread_averages_hz, SPREAD_MEMORIES, strict=True)
    ]
    shown = MixtureView(predicted, mixture.probability, averages)
    view = View(x, unpack(P, zero=pipeline.known_axes), memory, results, coming, w.site, shown)
    return w._replace(
        is_first=0.0,
        pending=PendingEpoch(coming.dt, coming.visible, w.incoming.truth),
        mixture=mixture,
        spread_averages_hz=averages,
        mode_probabilities=probabilities,
        x=x,
        P=P,
        memory=memory,
        observation=observation.values(view),
        truth=select(is_first, w.incoming.truth, truth),
        **scores(belief, truth, reward, tree_at(w.action, costs)),
    )


@lru_cache(maxsize=32)
def program_of(pipeline: Pipeline, kind: str, reward: Reward) -> Program[PerModeState]:
    """Return the program of an epoch, shared by all environments with the same arguments.

    Args:
        pipeline: modes and layout; the tunings are part of the state.
        kind: kind of observation.
        reward: function of (belief, truth).
    """
    observation, modes = Observation(pipeline, kind, "per-mode"), len(pipeline.modes)
    blank = blank_environment(pipeline.layout, modes, reward, len(observation))
    template = PerModeState(
        settings=settings_of(Bank(pipeline.modes), pipeline.layout),
        mixture=begin(pipeline, blank["x"], blank["P"]),
        spread_averages_hz=[0.0] * len(SPREAD_MEMORIES),
        mode_probabilities=[1.0 / modes] * modes,
        **blank,
    )
    step = partial(epoch, pipeline=pipeline, observation=observation, reward=reward)
    return Program(step, template)
