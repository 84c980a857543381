"""The base class of environments, which run on an engine and can be copied.

A copy computes exactly what the original would compute.
"""

from collections.abc import Callable
from copy import deepcopy
from math import fsum
from typing import Any, Self

import numpy as np
from gymnasium.error import ResetNeeded

from mmwave_env.compiler.threads import portions, share
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.engines.smoothing import smoothed_again
from mmwave_env.engines.vector_step import Tally
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, MODE, limits_of
from mmwave_env.interface.info import SMOOTHED_KEY, drawn_rows, reported
from mmwave_env.interface.reward import term_names
from mmwave_env.interface.signed import after_update
from mmwave_env.io.lookup import choose
from mmwave_env.metrics import INFO_KEYS, ate, scored
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.task import Task
from mmwave_env.world.episode import EpisodeBatch
from mmwave_env.world.keys import Keys

# maximum numbers of episodes that a job replays (REPLAYED) or filters (FILTERED), to save memory
REPLAYED = 8
FILTERED = 256


class Baseline:
    """The baseline of a paired reward, which is subtracted from the agent's rewards.

    If actions are corrections, each step computes the baseline: the reward of the uncorrected
    belief. Otherwise, it is an IMM's rewards, known as soon as an episode is loaded.

    Args:
        task: the task, whose ``baseline`` is the bank of the IMM.
        batch: the batch that runs the episodes.
        threads: maximum number of threads in use; results do not depend on it.
    """

    def __init__(self, task: Task, batch: Batch, threads: int = 1) -> None:
        self._task = task
        self._batch = batch
        self._threads = threads
        self._rewards = np.zeros((batch.n, 0), np.float32)

    def begin(self, places: Index, episodes: Callable[[Index], EpisodeBatch]) -> None:
        """Run the IMM on the episodes that begin in some environments (n,).

        Args:
            places: indices of these environments.
            episodes: function that returns episodes, given the indices of their environments.
        """
        task = self._task
        if task.action == CORRECTION:
            return
        planar = task.pipeline.planar
        missing = self._batch.state.length.max() - self._rewards.shape[1]
        self._rewards = np.pad(self._rewards, ((0, 0), (0, max(0, missing))))

        def run(some: Index) -> None:
            assert task.baseline is not None
            played = run_imm(task.baseline, task.reward, episodes(some), "reward", planar=planar)
            rewards = played["reward"]
            self._rewards[some, : rewards.shape[1]] = rewards

        parts = portions(len(places), self._threads, FILTERED)
        share(run, [(places[part],) for part in parts], self._threads)

    def subtract(self, rewards: Array, places: Index) -> None:
        """Subtract the baseline from the rewards (N,) of the epoch that was just scored.

        The result is rounded to single precision, in which agents receive rewards, so that
        recorded training runs can be repeated exactly.

        Args:
            rewards: (N,) rewards of all environments, changed in place.
            places: (n,) indices of the environments whose rewards change.
        """
        batch = self._batch
        if self._task.action == CORRECTION:
            earned = batch.read(batch.at.reported.reward, np.float32)[places]
        else:
            earned = self._rewards[places, batch.state.epoch[places] - 2]
        rewards[places] = rewards[places].astype(np.float32) - earned

    def rest(self, places: Index) -> Array:
        """Return the IMM's total reward (n,) in the remaining epochs of each environment."""
        tracks = self._batch.state
        spans = zip(places, tracks.epoch[places] - 1, tracks.length[places], strict=True)
        return np.array([fsum(self._rewards[place, now:end]) for place, now, end in spans])


class Environment:
    """Environments that run on an engine and can be copied by ``deepcopy`` and ``pickle``.

    Compiled code is not copied: a copy creates it again. Everything else is copied, but a deep copy
    shares the task, including the source of episodes, because no step changes the task.
    """

    _engine: Engine
    _baseline: Baseline | None
    _set_up: Callable[[], None]  # creates the attributes that are not copied

    def _take_task(self, task: Task, observation: str, smoothed: bool, n: int = 1) -> None:
        """Store the task of n environments, which have no episode yet."""
        if smoothed and task.action != MODE:
            raise ValueError(
                f"smoothed: found {smoothed} with action={task.action!r}, expected False"
            )
        self._task = task
        self._observation_kind = observation
        self._smoothing = smoothed
        modes = len(task.pipeline.modes)
        self._limits = limits_of(task.action, modes)
        self._tally = Tally(n, len(task.pipeline.position_axes), smoothed, modes + 1)
        self._keys = np.zeros(n, np.uint64)  # of the episodes, if they have keys
        self._begun = False

    def _start_engine(
        self, pipeline: Pipeline, n: int = 1, on_floats: bool = False, threads: int = 1
    ) -> None:
        """Make the engine of n environments, its replay and its baseline."""
        task = self._task
        kind = self._observation_kind
        self.source = task.source
        self.radio = task.radio
        self.reward = task.reward
        self.reward_terms = (*term_names(task.reward), "cost")
        corrections = task.action == CORRECTION
        if corrections:
            choose({"full": None}, kind, 'observation, with action="correction",')
            kind = "signed"
        bank = task.bank
        self._engine = Engine(
            pipeline, n, task.reward, kind, bank, on_floats, threads, task.action, base=task.base
        )
        if corrections:  # leave out the features that depend on the coming epoch
            self._engine.show(after_update(pipeline))
        self.modes = pipeline.modes
        self.bank = task.bank
        self.observation = self._engine.observation
        self._baseline = Baseline(task, self._engine, threads) if task.baseline else None

    @property
    def _drawn(self) -> tuple[dict[str, Any], int, list[str]]:
        """Return rows that pictures show, the number of position axes, and the names of actions."""
        rows = drawn_rows(self._engine.at, self._engine.span)
        return rows, len(self._task.pipeline.position_axes), self.observation.actions

    def belief(self, environment: int = 0) -> Belief:
        """Return the belief after the last epoch in which an action was taken.

        Args:
            environment: index of the environment, if there are several.

        Raises:
            ResetNeeded: no episode is under way.
        """
        self._require_begun("belief")
        at = reported(self._engine.at)
        x = self._engine.read(at.x)[environment].tolist()
        P = self._engine.read(at.P)[environment].tolist()
        return self._engine.pipeline.belief(x, P)

    def _scene_of(self, place: int) -> Scene | None:
        return self._task.scene_of(int(self._keys[place]))

    def _require_begun(self, call: str) -> None:
        if not self._begun:
            raise ResetNeeded(f"Call reset before {call}: there is no episode under way.")

    def _begin_baseline(self, places: Index) -> None:
        if self._baseline:
            self._baseline.begin(places, self._episodes)

    def _begin_keys(self, keys: Keys, places: Index, threads: int = 1) -> list[str]:
        """Begin the episodes with given keys (n,) in some environments (n,); return their names.

        Episodes are simulated while the environments step. If users follow given trajectories, or
        if the engine runs in plain Python, complete episodes are drawn here instead, on at most
        ``threads`` threads.
        """
        self._keys[places] = keys
        source = self._task.simulated
        engine = self._engine
        if engine.on_floats or not source.travels:
            episodes = self._task.tables(keys, threads)
            engine.load(episodes, places)
            return episodes.names
        starts = source.begin(keys)
        engine.begin(source, starts, places)
        if self._task.pipeline.planar:  # as in Episode.on_flat_ground
            prior = engine.at.site.prior_x
            engine.write(prior[2], starts.first[:, 2], places)
            engine.write(prior[5], 0.0, places)
        return [source.names[kind] for kind in starts.kinds]

    def _episodes(self, places: Index) -> EpisodeBatch:
        """Return the complete current episodes of some environments (n,)."""
        engine = self._engine
        if engine.state.feed.run:
            return self._task.tables(self._keys[places])
        return engine.episodes(places)

    def _begin_tracks(self, places: Index) -> None:
        """Start the baseline and the tally for episodes that just began in some environments."""
        self._begin_baseline(places)
        engine = self._engine
        if engine.state.feed.run:
            step_s = np.full(len(places), self._task.simulated.dt)
        else:
            step_s = engine.steps_s(places)
        self._tally.begin(places, step_s, engine.state.length[places])

    def _metrics_of(self, ended: Index, threads: int = 1) -> dict[str, Array]:
        """Compute the final metrics of episodes that ended in some environments (k,)."""
        epochs = self._engine.state.epoch[ended] - 1
        figures = self._tally.metrics(ended, epochs)
        metrics = {INFO_KEYS[name]: values for name, values in figures.items()}
        if not self._smoothing:
            return metrics
        jobs = []
        for steps in set(epochs.tolist()):
            alike = np.flatnonzero(epochs == steps)
            jobs += [(alike[part], steps) for part in portions(len(alike), threads, REPLAYED)]
        smoothed = np.zeros(len(ended))
        task = self._task

        def smooth(some: Index, steps: int) -> None:
            episodes = self._episodes(ended[some])
            actions = self._tally.counts.modes[:steps, ended[some]].T
            _, _, errors, _ = smoothed_again(task.pipeline, task.bank, episodes, actions)
            smoothed[some] = ate(errors[:, scored(steps)])

        share(smooth, jobs, threads)
        return metrics | {SMOOTHED_KEY: smoothed}

    def _charge(self, rewards: Array, places: Index) -> None:
        """Add (worst reward - baseline) for each epoch that is missing because of an early end."""
        assert self._task.worst is not None
        engine = self._engine
        rewards[places] += self._task.worst * (engine.state.length - engine.state.epoch + 1)[places]
        if self._baseline:
            rewards[places] -= self._baseline.rest(places)

    def _set_up_noting(self) -> None:
        """Call ``_set_up``; remember which attributes it creates, as they are not copied."""
        attributes = set(vars(self))
        self._set_up()
        self._remade = frozenset(vars(self)) - attributes

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes that a copy cannot create itself."""
        kept = {key: value for key, value in vars(self).items() if key not in self._remade}
        return kept | {"tracks": self._engine.state}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue exactly like the copied environment."""
        vars(self).update(state)
        tracks = vars(self).pop("tracks")
        self._set_up_noting()
        if len(tracks.feed.kept):  # the address of compiled code differs between processes
            feed = tracks.feed._replace(run=self._task.simulated.world.on_lanes())
            tracks = tracks._replace(feed=feed)
        self._engine.state = tracks
        if self._begun:
            self._begin_baseline(np.arange(self._engine.n))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return an independent copy."""
        twin = type(self).__new__(type(self))
        memo |= {id(self): twin, id(self._task): self._task}
        twin.__setstate__(deepcopy(self.__getstate__(), memo))
        return twin
