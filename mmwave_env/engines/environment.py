"""The base class of environments, which run on an engine and can be copied.

A copy computes exactly what the original would compute.
"""

from copy import deepcopy
from math import fsum
from typing import Any, Self

import numpy as np
from gymnasium.error import ResetNeeded

from mmwave_env.compiler.program import Repeated, StepIO, laid_out
from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.engines.vector_step import StepResult, Tally, step_blocks
from mmwave_env.filters.belief import Belief
from mmwave_env.interface.actions import CORRECTION, limits_of
from mmwave_env.interface.info import (
    COST_KEY,
    FLAGS,
    NONFINITE_KEY,
    STATE_KEYS,
    Info,
    drawn_rows,
    info_rows,
    mask_keys,
    reported,
    warn_of_nonfinite,
)
from mmwave_env.interface.observation import OBSERVATIONS
from mmwave_env.interface.reward import term_names
from mmwave_env.interface.signed import after_update
from mmwave_env.io.lookup import choose, require_extra
from mmwave_env.metrics import DIVERGENCE_M, INFO_KEYS
from mmwave_env.numerics.numbers import Array, Array32, Index
from mmwave_env.task import Task
from mmwave_env.world.episode import Episode, EpisodeBatch
from mmwave_env.world.keys import Keys, Streams

BEGUN = 512  # maximum number of episodes that begin in one call, to save memory


class Environment:
    """Environments that run on an engine and can be copied by ``deepcopy`` and ``pickle``.

    Compiled code is not copied: a copy creates it again. Everything else is copied, but a deep copy
    shares the task, including the source of episodes, because no step changes the task.
    """

    _engine: Engine
    _backend = "lanes"
    _gallery: Any  # draws pictures; None without a render mode

    def _take_task(self, task: Task, observation: str, n: int = 1, threads: int = 1) -> None:
        """Store the task of n environments, which have no episode yet, and set up their engine."""
        choose(OBSERVATIONS, observation, "observation")
        self._task = task
        self._observation_kind = observation
        self._limits = limits_of(task.action, len(task.pipeline.modes))
        self._tally = Tally(n, len(task.pipeline.position_axes))
        self._keys = np.zeros(n, np.uint64)  # of the episodes, if they have keys
        self._names = np.full(n, "", object)  # of the episodes, for pictures
        self._streams = Streams(n)
        self._threads = threads  # maximum number in use; results do not depend on it
        self._imm_rewards = np.zeros((n, 0), np.float32)  # of the episodes, if rewards are paired
        self._begun = False
        self._set_up_noting()

    def _set_up(self) -> None:
        """Create all objects that the arguments determine, for a new environment or a copy."""
        task = self._task
        pipeline = task.pipeline
        on_floats = self._backend == "filterpy"
        if on_floats:
            require_extra("filterpy", "filterpy", 'backend="filterpy"')
            from mmwave_env.filters.filterpy_reference import filterpy_pipeline

            pipeline = filterpy_pipeline(pipeline)
        kind = self._observation_kind
        self.source = task.source
        self.radio = task.radio
        self.reward = task.reward
        self.reward_terms = (*term_names(task.reward), "cost")
        corrections = task.action == CORRECTION
        if corrections:
            choose({"full": None}, kind, 'observation, with action="correction",')
            kind = "signed"
        n = len(self._keys)
        self._engine = Engine(
            pipeline, n, task.reward, kind, task.bank, on_floats, self._threads, task.action,
            base=task.base,
        )  # fmt: skip
        if corrections:  # leave out the features that depend on the coming epoch
            self._engine.show(after_update(pipeline))
        self.modes = pipeline.modes
        self.bank = task.bank
        self.observation = self._engine.observation
        self._lay_out_steps(self._engine.at)

    def _lay_out_steps(self, at: Any) -> None:
        """Choose the outputs of a step, and make its buffers; ``at`` is the engine's."""
        shown = info_rows(at)
        parts = {"reward": at.reward, "nees": at.nees, "error": at.error}
        parts["covariance"] = reported(at).P[:3]
        parts |= {key: [] for key in FLAGS} | shown
        rows, columns = laid_out(parts)
        self._info_columns = {
            key: (slice(None), 0, columns[key]) for key in shown if key not in FLAGS
        }
        self._groups = len(at.memory.accepted)
        self._step_io = self._engine.io(rows)
        self._mask_keys = mask_keys([*shown, "mode", COST_KEY])  # of infos from steps
        self._run_step = Repeated(step_blocks)

    def _step_engine(self, actions: Index, numbers: Array | None) -> tuple[StepResult, int, Info]:
        """Apply all actions and run the modes on the next epoch, as :meth:`Engine.step` does.

        Args:
            actions: (n,) numbers of the modes; infos contain this array itself, not a copy.
            numbers: (n, k) the agents' weights of the modes or corrections of the beliefs;
                ``actions`` must then be zeros. None if the agents choose modes.

        Returns:
            New results; the number of environments that have no epoch left; and new infos about all
            environments, without Gymnasium's masks.
        """
        engine = self._engine
        io = self._step_io
        n = len(actions)
        if numbers is not None:
            io.inputs[:, 0, 1:] = numbers
        ends = np.zeros((2, n), np.bool_)
        flags = np.empty((2, n, self._groups), np.bool_)
        observations = np.empty((n, 1, len(io.obs_rows)), np.float32)
        result = StepResult(
            observations[:, 0], np.empty(n), ends[0], ends[1], flags[0], flags[1], np.empty(n)
        )
        # Infos need new arrays of outputs, as earlier infos are views of the previous arrays.
        outputs = np.empty_like(io.outputs)
        io = StepIO(io.input_rows, io.inputs, io.output_rows, outputs, io.obs_rows, observations)
        self._step_io = io
        records = (engine.program.blank, engine.state, io, actions, result, self._tally.counts)
        run = 0
        if engine.on_floats:
            io.inputs[:, 0, 0] = actions
            engine.advance(io)
        else:
            run = engine.program.on_lanes()
        ended = sum(self._run_step(engine.parts, len(engine.parts), run, *records))
        engine.trust(io)
        infos: Info = {key: outputs[columns] for key, columns in self._info_columns.items()}
        infos |= {"accepted": result.accepted, "rejected": result.rejected, "mode": actions}
        infos[COST_KEY] = result.cost
        return result, ended, infos

    def _score(self, result: StepResult, places: Index) -> None:
        """Let a step's rewards in some environments (k,) be what the task pays.

        The baseline is subtracted. The difference is rounded to single precision, in which agents
        receive rewards, so that recorded training runs can be repeated exactly. Diverged episodes
        terminate; for each epoch that is missing then, (worst reward - baseline) is added.
        """
        task = self._task
        engine = self._engine
        rewards = result.rewards
        if task.baseline:
            if task.action == CORRECTION:
                earned = engine.read(engine.at.reported.reward, np.float32)[places]
            else:
                earned = self._imm_rewards[places, engine.state.epoch[places] - 2]
            rewards[places] = rewards[places].astype(np.float32) - earned
        if task.worst is None:
            return
        distance = engine.read(engine.at.distance)[places]
        result.terminated[places] = ~(distance <= DIVERGENCE_M)
        result.truncated[result.terminated] = False
        lost = np.flatnonzero(result.terminated)
        first = engine.state.epoch[lost] - 1
        end = engine.state.length[lost]
        rewards[lost] += task.worst * (end - first)
        if task.baseline:
            spans = zip(lost, first, end, strict=True)
            rewards[lost] -= [fsum(self._imm_rewards[place, a:b]) for place, a, b in spans]

    def _run_first_epoch(self, places: Index) -> tuple[Array32, Info]:
        """Run the modes on the next epoch in environments just loaded; leave the others unchanged.

        Returns:
            Observations (n, features) and the infos of :data:`STATE_KEYS` (n, ...), valid only for
            the environments ``places``.
        """
        engine = self._engine
        observations = engine.step(0, places)
        rows = info_rows(engine.at)
        return observations, {key: engine.read(rows[key]) for key in STATE_KEYS}

    def _generator(self, place: int) -> np.random.Generator:
        """Return the generator of an environment, for episodes without keys."""
        return self._streams.generator(place)

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

    def _require_begun(self, call: str) -> None:
        if not self._begun:
            raise ResetNeeded(f"Call reset before {call}: there is no episode under way.")

    def _begin_baseline(self, episodes: EpisodeBatch | list[Episode], places: Index) -> None:
        """Run the IMM of a paired reward on episodes that begin in some environments (n,)."""
        task = self._task
        assert task.baseline
        planar = task.pipeline.planar
        rewards = run_imm(task.baseline, task.reward, episodes, "reward", planar=planar)["reward"]
        missing = max(0, rewards.shape[1] - self._imm_rewards.shape[1])
        self._imm_rewards = np.pad(self._imm_rewards, ((0, 0), (0, missing)))
        self._imm_rewards[places, : rewards.shape[1]] = rewards

    def _begin_episodes(self, places: Index, keys: Keys | None) -> Info:
        """Begin episodes in some environments (n,): with these keys, or each environment's next.

        Returns:
            Infos about the episodes, arrays with one entry for each environment.
        """
        task = self._task
        engine = self._engine
        n = len(self._keys)
        infos: Info = {"episode_name": np.full(n, None, object), "nonfinite": np.zeros(n, np.int64)}
        if task.has_keys:
            self._keys[places] = self._streams.keys(places) if keys is None else keys
            infos["episode_key"] = self._keys.copy()
        for first in range(0, len(places), BEGUN):
            some = places[first : first + BEGUN]
            names, nonfinite = self._begin_some(some)
            infos["episode_name"][some] = names
            infos["nonfinite"][some] = nonfinite
        self._names[places] = infos["episode_name"][places]
        if engine.state.feed.run:
            step_s = np.full(len(places), task.simulated.dt)
        else:
            step_s = engine.steps_s(places)
        self._tally.begin(places, step_s, engine.state.length[places])
        return infos

    def _begin_some(self, places: Index) -> tuple[list[str], list[int] | int]:
        """Begin the next episodes; return their names, and how many of their values are not finite.

        Episodes with keys are simulated while the environments step. If users follow given
        trajectories, or if the engine runs in plain Python, complete episodes are drawn here
        instead. If actions are corrections, the baseline is the uncorrected belief, not an IMM.
        """
        task = self._task
        engine = self._engine
        paired = task.baseline and task.action != CORRECTION
        if not task.has_keys:
            drawn = [task.source.sample(self._generator(place)) for place in places.tolist()]
            for episode in drawn:
                episode.require_truth()
            engine.load(drawn, places)
            if paired:
                self._begin_baseline(drawn, places)
            return [episode.name for episode in drawn], [episode.nonfinite for episode in drawn]
        keys = self._keys[places]
        source = task.simulated
        whole = engine.on_floats or not source.travels
        if whole or paired:
            episodes = source.sample_batch(keys, self._threads)
        if paired:
            self._begin_baseline(episodes, places)
        if whole:
            engine.load(episodes, places)
            return episodes.names, 0
        starts = source.begin(keys)
        engine.begin(source, starts, places)
        return starts.names, 0

    def _begin_pictures(self, places: Index) -> None:
        """Clear the pictures of some environments (n,), whose episodes begin."""
        if self._gallery:
            names = self._names.tolist()
            scenes = self._task.scene_of
            keys = self._keys.tolist()
            self._gallery.begin(places, names, lambda i: scenes(keys[i]), self._engine.column)

    def _final_infos(self, ended: Index) -> Info:
        """Return the infos (k,) about whole episodes, which ended in some environments (k,)."""
        lost = self._tally.nonfinite(ended)
        if lost.any():
            warn_of_nonfinite()
        epochs = self._engine.state.epoch[ended] - 1
        figures = self._tally.metrics(ended, epochs)
        infos = {INFO_KEYS[name]: values for name, values in figures.items()}
        return infos | {NONFINITE_KEY: lost}

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

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return an independent copy."""
        twin = type(self).__new__(type(self))
        memo |= {id(self): twin, id(self._task): self._task}
        twin.__setstate__(deepcopy(self.__getstate__(), memo))
        return twin
