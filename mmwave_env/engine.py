"""The epoch of an environment, for one or many at once.

Take the chosen mode's candidate as the belief, score it against the truth, load the next
epoch and let every mode consider it. All modes are considered as soon as a measurement is
there, because the observation shows how each would see it; the action then only picks.
Nothing an action does changes the world, so episodes are loaded whole.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.arithmetic import Number, where
from mmwave_env.episode import Episode
from mmwave_env.estimator.algebra import pack, unpack
from mmwave_env.estimator.batch import Batch, Incoming, blank_incoming, blank_site
from mmwave_env.estimator.belief import Belief
from mmwave_env.estimator.imm import (
    Mixture,
    begin,
    estimate,
    imm_epoch,
    restart,
    stay_matrix,
)
from mmwave_env.estimator.pipeline import (
    Candidate,
    Memory,
    Pipeline,
    Site,
    anticipate,
    commit,
    consider,
    start,
)
from mmwave_env.estimator.program import Program
from mmwave_env.estimator.trees import select
from mmwave_env.observation import Observation, View
from mmwave_env.reward import Reward


class Workspace(NamedTuple):
    """Everything an environment holds between two epochs.

    Attributes:
        incoming: the epoch under consideration.
        site: anchors, carrier and prior.
        fresh: 1 to start over from the prior instead of committing.
        action: the mode to commit to.
        held: the epoch whose candidates wait for an action.
        x, P: (7,), (28,) belief after the last committed epoch.
        memory: of the track.
        candidates: per mode, for the epoch held.
        observation: (features,).
        reward: of the last committed epoch.
        truth: (6,) of that epoch; where no epoch is committed yet, of the first.
        error: (3,) its position error, m.
        distance: length of the error, m.
        nees: its NEES.
        P_predicted: (28,) covariance predicted for it.
    """

    incoming: Incoming
    site: Site
    fresh: Number
    action: Number
    held: Incoming
    x: list[Number]
    P: list[Number]
    memory: Memory
    candidates: list[Candidate]
    observation: list[Number]
    reward: Number
    truth: list[Number]
    error: list[Number]
    distance: Number
    nees: Number
    P_predicted: list[Number]


def _template(pipeline: Pipeline, features: int) -> Workspace:
    layout = pipeline.layout
    groups = [0.0] * len(layout.groups)
    incoming, site = blank_incoming(layout), blank_site(layout)
    candidate = Candidate(site.prior_x, site.prior_P, site.prior_P, groups, groups, 0.0, 0.0)
    return Workspace(
        incoming=incoming,
        site=site,
        fresh=1.0,
        action=0.0,
        held=incoming,
        x=site.prior_x,
        P=site.prior_P,
        memory=start(pipeline),
        candidates=[candidate for _ in pipeline.modes],
        observation=[0.0] * features,
        reward=0.0,
        truth=incoming.truth,
        error=[0.0] * 3,
        distance=0.0,
        nees=0.0,
        P_predicted=site.prior_P,
    )


def epoch(w: Workspace, pipeline: Pipeline, observation: Observation, reward: Reward) -> Workspace:
    """One step of an environment, on numbers."""
    chosen = w.candidates[0]
    cost: Number = pipeline.modes[0].cost
    for m in range(1, len(pipeline.modes)):
        picked = w.action > m - 0.5
        chosen = select(picked, w.candidates[m], chosen)
        cost = where(picked, pipeline.modes[m].cost, cost)
    done, truth = w.held.epoch(pipeline.layout), w.held.truth
    memory = commit(pipeline, w.action, w.x, chosen, w.memory, done.dt, done.visible)
    belief = Belief(chosen.x, unpack(chosen.P, zero=pipeline.pinned), pipeline.position_axes)
    score = reward(belief, truth) - cost

    fresh = w.fresh > 0.5
    x = select(fresh, w.site.prior_x, chosen.x)
    P = select(fresh, w.site.prior_P, chosen.P)
    memory = select(fresh, start(pipeline), memory)
    coming = w.incoming.epoch(pipeline.layout)
    candidates = [consider(pipeline, m, x, P, memory, coming, w.site) for m in pipeline.modes]
    memory = anticipate(memory, candidates, coming)
    view = View(x, unpack(P, zero=pipeline.pinned), memory, candidates, coming, w.site)
    return w._replace(
        fresh=0.0,
        held=w.incoming,
        x=x,
        P=P,
        memory=memory,
        candidates=candidates,
        observation=observation.values(view),
        reward=score,
        truth=select(fresh, w.incoming.truth, truth),
        error=belief.error(truth),
        distance=belief.distance(truth),
        nees=belief.nees(truth),
        P_predicted=chosen.P_predicted,
    )


@lru_cache(maxsize=32)
def _program(pipeline: Pipeline, kind: str, reward: Reward) -> Program[Workspace]:
    """The compiled epoch, shared by every environment that is set up alike."""
    observation = Observation(pipeline, kind)

    def function(w: Workspace) -> Workspace:
        return epoch(w, pipeline, observation, reward)

    return Program(function, _template(pipeline, len(observation)))


class Engine:
    """N environments in step: episodes in, actions in, observations and scores out.

    Args:
        pipeline: modes and layout.
        n: number of environments.
        reward: function of (belief, truth).
        observation: "full" or "prior".
        on_floats: run in plain Python instead of on lanes (the filterpy twin needs it).
    """

    def __init__(
        self,
        pipeline: Pipeline,
        n: int,
        reward: Reward,
        observation: str = "full",
        on_floats: bool = False,
    ) -> None:
        self.pipeline = pipeline
        self.observation = Observation(pipeline, observation)
        program = _program(pipeline, observation, reward)
        action = np.array([program.index.action])
        self._batch = Batch(program, pipeline.layout, n, action, on_floats)
        self.size = self._batch.program.size
        self.at, self.span = self._batch.at, self._batch.span
        self.read, self.column = self._batch.read, self._batch.column

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Start over with one episode each and consider its first epoch."""
        self._batch.begin(episodes)

    def step(self, actions: NDArray[np.int64] | np.int64) -> None:
        """Commit every environment to its mode (n,), or all to one, and consider the next epoch."""
        given = np.empty((self._batch.n, 1, 1))
        given[:, 0, 0] = actions
        self._batch.advance(given)

    def observations(self) -> NDArray[np.float32]:
        """The current observations (n, features), a copy."""
        return self.read(self.at.observation).astype(np.float32)


class ImmWorkspace(NamedTuple):
    """Everything an IMM holds between two epochs.

    Attributes:
        incoming: the epoch just filtered.
        site: anchors, carrier and prior.
        fresh: 1 to start over from the prior.
        mixture: belief and probability of every mode.
        x, P: (7,), (28,) the combined belief.
        reward, error, nees: of the epoch, as in :class:`Workspace`.
    """

    incoming: Incoming
    site: Site
    fresh: Number
    mixture: Mixture
    x: list[Number]
    P: list[Number]
    reward: Number
    error: list[Number]
    nees: Number


@lru_cache(maxsize=32)
def _imm_program(
    pipeline: Pipeline, transition: tuple[tuple[float, ...], ...], reward: Reward
) -> Program[ImmWorkspace]:
    def function(w: ImmWorkspace) -> ImmWorkspace:
        mixture = restart(w.fresh > 0.5, pipeline, w.site, w.mixture)
        coming = w.incoming.epoch(pipeline.layout)
        mixture = imm_epoch(pipeline, transition, mixture, coming, w.site)
        x, P = estimate(mixture)
        belief = Belief(x, P, pipeline.position_axes)
        truth = w.incoming.truth
        return w._replace(
            fresh=0.0,
            mixture=mixture,
            x=x,
            P=pack(P),
            reward=reward(belief, truth),
            error=belief.error(truth),
            nees=belief.nees(truth),
        )

    incoming, site = blank_incoming(pipeline.layout), blank_site(pipeline.layout)
    mixture = begin(pipeline, site.prior_x, site.prior_P)
    template = ImmWorkspace(
        incoming, site, 1.0, mixture, site.prior_x, site.prior_P, 0.0, [0.0] * 3, 0.0
    )
    return Program(function, template)


class ImmEngine:
    """N interacting-multiple-model estimators in step; no actions, it weighs the modes itself.

    Args:
        pipeline: modes and layout.
        n: number of estimators.
        reward: function of (belief, truth), for comparison with policies.
        transition: (modes, modes) transition probabilities, rows sum to 1; None for the
            default, which stays with probability 0.95.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        n: int,
        reward: Reward,
        transition: tuple[tuple[float, ...], ...] | None = None,
    ) -> None:
        transition = transition or stay_matrix(len(pipeline.modes))
        self.pipeline = pipeline
        self._batch = Batch(_imm_program(pipeline, transition, reward), pipeline.layout, n)
        self.at, self.read = self._batch.at, self._batch.read

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Start over with one episode each and filter the first epoch."""
        self._batch.begin(episodes)

    def step(self) -> None:
        """Filter the next epoch."""
        self._batch.advance()
