"""The epoch of an environment whose modes share a belief.

A step takes the chosen mode's candidate as the belief, scores it against the truth, loads the
next epoch and runs every mode on it. All modes run before the action, because the observation
shows the result of each mode; the action then only picks a candidate. No action changes the
world, so episodes are loaded whole.
"""

from functools import lru_cache, partial
from typing import NamedTuple

from mmwave_env.compiler.program import Program
from mmwave_env.engines.epoch_state import PendingEpoch, begun, blank_environment, scores
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.memory import Memory, memory_after, memory_before
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.filters.update import ModeResult
from mmwave_env.interface.features import View
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.reward import Reward
from mmwave_env.models.measurement import Site
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Number
from mmwave_env.numerics.pytree import select, tree_at
from mmwave_env.world.episode import Incoming


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


def epoch(w: EnvState, pipeline: Pipeline, observation: Observation, reward: Reward) -> EnvState:
    """Compute one step of an environment, on numbers."""
    layout, modes = pipeline.layout, pipeline.modes
    chosen: ModeResult = tree_at(w.action, w.candidates)
    cost: Number = tree_at(w.action, [mode.cost for mode in modes])
    dt, visible, truth = w.pending
    memory = memory_after(layout, w.action, w.x, chosen, w.memory, dt, visible)
    belief = Belief(chosen.x, unpack(chosen.P, zero=pipeline.known_axes), pipeline.position_axes)

    x, P, memory = begun(w, chosen.x, chosen.P, memory, pipeline)
    coming = w.incoming.epoch(layout)
    candidates = [predict_update(pipeline, m, x, P, memory, coming, w.site) for m in modes]
    memory = memory_before(memory, candidates, coming, layout)
    view = View(x, unpack(P, zero=pipeline.known_axes), memory, candidates, coming, w.site)
    return w._replace(
        is_first=0.0,
        pending=PendingEpoch(coming.dt, coming.visible, w.incoming.truth),
        x=x,
        P=P,
        memory=memory,
        candidates=[result._replace(x_predicted=[], P_predicted=[]) for result in candidates],
        observation=observation.values(view),
        truth=select(w.is_first > 0.5, w.incoming.truth, truth),
        **scores(belief, truth, reward, cost),
    )


@lru_cache(maxsize=32)
def program_of(pipeline: Pipeline, kind: str, reward: Reward) -> Program[EnvState]:
    """Return the program of an epoch, shared by all environments with the same arguments."""
    observation, modes = Observation(pipeline, kind), len(pipeline.modes)
    blank = blank_environment(pipeline.layout, modes, reward, len(observation))
    groups = [0.0] * len(pipeline.layout.groups)
    candidate = ModeResult(blank["x"], blank["P"], [], [], groups, groups, 0.0, 0.0)
    step = partial(epoch, pipeline=pipeline, observation=observation, reward=reward)
    return Program(step, EnvState(candidates=[candidate] * modes, **blank))
