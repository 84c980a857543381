"""The epoch of an environment whose modes share a belief.

A step takes the chosen mode's candidate as the belief, scores it against the truth, loads the
next epoch and runs every mode on it. All modes run before the action, because the observation
shows the result of each mode; the action then only picks a candidate. No action changes the
world, so episodes are loaded whole.
"""

from functools import lru_cache, partial
from typing import NamedTuple

from mmwave_env.compiler.program import Program
from mmwave_env.features import View
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.memory import Memory, initial_memory, memory_after, memory_before
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.filters.update import ModeResult
from mmwave_env.models.measurement import Site, blank_site
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Number
from mmwave_env.numerics.pytree import select, tree_at
from mmwave_env.observation import Observation
from mmwave_env.reward import Reward, term_names, terms_of, total
from mmwave_env.world.episode import Incoming, blank_incoming


class PendingEpoch(NamedTuple):
    """The parts of an epoch that are needed after its candidates are computed."""

    # dt, visible: as in :class:`~mmwave_env.models.measurement.Epoch`
    dt: Number
    visible: list[Number]
    truth: list[Number]  # (6,) true position (m) and velocity (m/s)


class EnvState(NamedTuple):
    """The state of an environment between two epochs."""

    incoming: Incoming  # the epoch under consideration
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior instead of committing
    action: Number  # the mode to commit to
    pending: PendingEpoch  # the epoch whose candidates wait for an action
    # x, P: (7,), (28,) belief after the last committed epoch
    x: list[Number]
    P: list[Number]
    memory: Memory  # memory of the track
    # one per mode, for the pending epoch, without the predicted beliefs: the smaller environments
    # are, the more of them fit into a cache
    candidates: list[ModeResult]
    observation: list[Number]  # (features,)
    reward: Number  # reward of the last committed epoch
    reward_terms: list[Number]  # terms of the reward, and minus the mode's cost
    truth: list[Number]  # (6,) truth of that epoch; if no epoch is committed yet, of the first
    error: list[Number]  # (3,) position error of that epoch, m
    distance: Number  # length of the error, m
    nees: Number  # NEES of that epoch


def _template(pipeline: Pipeline, features: int, reward: Reward) -> EnvState:
    layout = pipeline.layout
    groups = [0.0] * len(layout.groups)
    incoming, site = blank_incoming(layout), blank_site(layout)
    candidate = ModeResult(site.prior_x, site.prior_P, [], [], groups, groups, 0.0, 0.0)
    return EnvState(
        incoming=incoming,
        site=site,
        is_first=1.0,
        action=0.0,
        pending=PendingEpoch(0.0, [0.0] * len(layout.groups), incoming.truth),
        x=site.prior_x,
        P=site.prior_P,
        memory=initial_memory(pipeline.layout, len(pipeline.modes)),
        candidates=[candidate for _ in pipeline.modes],
        observation=[0.0] * features,
        reward=0.0,
        reward_terms=[0.0] * (len(term_names(reward)) + 1),
        truth=incoming.truth,
        error=[0.0] * 3,
        distance=0.0,
        nees=0.0,
    )


def epoch(w: EnvState, pipeline: Pipeline, observation: Observation, reward: Reward) -> EnvState:
    """Compute one step of an environment, on numbers."""
    chosen: ModeResult = tree_at(w.action, w.candidates)
    cost: Number = tree_at(w.action, [mode.cost for mode in pipeline.modes])
    dt, visible, truth = w.pending
    memory = memory_after(pipeline.layout, w.action, w.x, chosen, w.memory, dt, visible)
    belief = Belief(chosen.x, unpack(chosen.P, zero=pipeline.known_axes), pipeline.position_axes)
    terms = terms_of(reward, belief, truth)

    is_first = w.is_first > 0.5
    x = select(is_first, w.site.prior_x, chosen.x)
    P = select(is_first, w.site.prior_P, chosen.P)
    memory = select(is_first, initial_memory(pipeline.layout, len(pipeline.modes)), memory)
    coming = w.incoming.epoch(pipeline.layout)
    candidates = [predict_update(pipeline, m, x, P, memory, coming, w.site) for m in pipeline.modes]
    memory = memory_before(memory, candidates, coming, pipeline.layout)
    view = View(x, unpack(P, zero=pipeline.known_axes), memory, candidates, coming, w.site)
    return w._replace(
        is_first=0.0,
        pending=PendingEpoch(coming.dt, coming.visible, w.incoming.truth),
        x=x,
        P=P,
        memory=memory,
        candidates=[one._replace(x_predicted=[], P_predicted=[]) for one in candidates],
        observation=observation.values(view),
        reward=total(terms) - cost,
        reward_terms=[*terms.values(), 0.0 - cost],
        truth=select(is_first, w.incoming.truth, truth),
        error=belief.error(truth),
        distance=belief.distance(truth),
        nees=belief.nees(truth),
    )


@lru_cache(maxsize=32)
def program_of(pipeline: Pipeline, kind: str, reward: Reward) -> Program[EnvState]:
    """Return the program of an epoch, shared by all environments with the same arguments."""
    observation = Observation(pipeline, kind)
    step = partial(epoch, pipeline=pipeline, observation=observation, reward=reward)
    return Program(step, _template(pipeline, len(observation), reward))
