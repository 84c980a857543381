"""The epoch of an environment, for one or many at once.

Take the chosen mode's candidate as the belief, score it against the truth, load the next
epoch and let every mode consider it. All modes are considered as soon as a measurement is
there, because the observation shows how each would see it; the action then only picks.
Nothing an action does changes the world, so episodes are loaded whole.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import NO_ROWS, Program, rows_of
from mmwave_env.engines.batch import Batch
from mmwave_env.episodes.episode import Episode, EpisodeBatch, Incoming, blank_incoming
from mmwave_env.features import View
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.memory import Memory, initial_memory, memory_after, memory_before
from mmwave_env.filters.mode_result import ModeResult
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.models.epoch import Site, blank_site
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Number
from mmwave_env.numerics.pytree import select, tree_at
from mmwave_env.observation import Observation
from mmwave_env.reward import Reward


class PendingEpoch(NamedTuple):
    """What is needed of an epoch once its candidates are there."""

    # dt, visible: as in :class:`~mmwave_env.models.epoch.Epoch`
    dt: Number
    visible: list[Number]
    truth: list[Number]  # (6,) true position (m) and velocity (m/s)


class EnvState(NamedTuple):
    """Everything an environment holds between two epochs."""

    incoming: Incoming  # the epoch under consideration
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior instead of committing
    action: Number  # the mode to commit to
    pending: PendingEpoch  # the epoch whose candidates wait for an action
    # x, P: (7,), (28,) belief after the last committed epoch
    x: list[Number]
    P: list[Number]
    memory: Memory  # of the track
    # per mode, for the epoch held, without their ``P_predicted``: the less an environment holds,
    # the more of them fit into a cache
    candidates: list[ModeResult]
    observation: list[Number]  # (features,)
    reward: Number  # of the last committed epoch
    truth: list[Number]  # (6,) of that epoch; where no epoch is committed yet, of the first
    error: list[Number]  # (3,) its position error, m
    distance: Number  # length of the error, m
    nees: Number  # its NEES


def _template(pipeline: Pipeline, features: int) -> EnvState:
    layout = pipeline.layout
    groups = [0.0] * len(layout.groups)
    incoming, site = blank_incoming(layout), blank_site(layout)
    candidate = ModeResult(site.prior_x, site.prior_P, [], groups, groups, 0.0, 0.0)
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
        truth=incoming.truth,
        error=[0.0] * 3,
        distance=0.0,
        nees=0.0,
    )


def epoch(w: EnvState, pipeline: Pipeline, observation: Observation, reward: Reward) -> EnvState:
    """One step of an environment, on numbers."""
    chosen: ModeResult = tree_at(w.action, w.candidates)
    cost: Number = tree_at(w.action, [mode.cost for mode in pipeline.modes])
    dt, visible, truth = w.pending
    memory = memory_after(pipeline.layout, w.action, w.x, chosen, w.memory, dt, visible)
    belief = Belief(chosen.x, unpack(chosen.P, zero=pipeline.known_axes), pipeline.position_axes)
    score = reward(belief, truth) - cost

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
        candidates=[candidate._replace(P_predicted=[]) for candidate in candidates],
        observation=observation.values(view),
        reward=score,
        truth=select(is_first, w.incoming.truth, truth),
        error=belief.error(truth),
        distance=belief.distance(truth),
        nees=belief.nees(truth),
    )


@lru_cache(maxsize=32)
def _program(pipeline: Pipeline, kind: str, reward: Reward) -> Program[EnvState]:
    """The compiled epoch, shared by every environment that is set up alike."""
    observation = Observation(pipeline, kind)
    step = partial(epoch, pipeline=pipeline, observation=observation, reward=reward)
    return Program(step, _template(pipeline, len(observation)))


class Engine:
    """N environments in step: episodes in, actions in, observations and scores out.

    Args:
        pipeline: modes and layout.
        n: number of environments.
        reward: function of (belief, truth).
        observation: "full" or "prior".
        on_floats: run in plain Python instead of on lanes (the filterpy twin needs it).
        threads: how many may work at once; results do not depend on it.

    Attributes:
        batch: their workspaces and episodes.
        at, read, column, span: the batch's.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        n: int,
        reward: Reward,
        observation: str = "full",
        on_floats: bool = False,
        threads: int = 1,
    ) -> None:
        self.pipeline = pipeline
        self.observation = Observation(pipeline, observation)
        program = _program(pipeline, observation, reward)
        action = np.array([program.index.action])
        self.batch = Batch(program, pipeline.layout, n, action, on_floats, threads)
        self.at = self.batch.at
        self.read, self.column, self.span = self.batch.read, self.batch.column, self.batch.span
        self._obs_rows = rows_of(self.at.observation)

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Start over with one episode each and consider its first epoch."""
        self.batch.load(episodes)
        self.batch.advance()

    def load(self, episodes: EpisodeBatch | Sequence[Episode], places: Index) -> None:
        """Give some environments an episode, to start over with at the next run."""
        self.batch.load(episodes, places)

    def start(
        self, places: Index, output_rows: Index = NO_ROWS
    ) -> tuple[NDArray[np.float32], Array]:
        """Consider the first epoch in environments just loaded; the others stay as they are.

        Returns:
            As :meth:`step`, but sound only for these environments.
        """
        running = np.zeros(self.batch.n, np.bool_)
        running[places] = True
        io = self.batch.io(output_rows=output_rows, obs_rows=self._obs_rows)
        self.batch.advance(io, running)
        return io.observations[:, 0], io.outputs[:, 0]

    def step(
        self, actions: NDArray[np.integer[Any]] | np.int64, output_rows: Index = NO_ROWS
    ) -> tuple[NDArray[np.float32], Array]:
        """Commit every environment to its mode (n,), or all to one, and consider the next epoch.

        An environment just loaded starts its episode instead.

        Args:
            actions: numbers of the modes.
            output_rows: (k,) numbers of rows to return, of :func:`rows_of` parts of ``at``.

        Returns:
            The observations (n, features), and what to tell (n, k); fresh arrays.
        """
        io = self.batch.io(output_rows=output_rows, obs_rows=self._obs_rows)
        io.inputs[:, 0, 0] = actions
        self.batch.advance(io)
        return io.observations[:, 0], io.outputs[:, 0]

    def observations(self) -> NDArray[np.float32]:
        """The current observations (n, features), a copy."""
        return self.read(self.at.observation, np.float32)
