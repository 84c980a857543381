"""The engine: N tracks that run the verbs of :mod:`mmwave_env.engines.epoch` together.

The same engine serves everybody. Environments begin with :meth:`Engine.step`, and take the next
steps in :mod:`mmwave_env.engines.vector_step`, which runs the same kernel. Where a policy is asked
in every epoch of a track, :func:`play` calls :meth:`Engine.filter`, :meth:`Engine.decide` and
perhaps :meth:`Engine.correct`. Where all actions are known, or a rule or an IMM needs none,
:meth:`Engine.run` filters all epochs in one call of compiled code; else it plays them.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import NO_ROWS, Program, Stages, StepIO, rows_of
from mmwave_env.engines.batch import ALL, Batch, Places
from mmwave_env.engines.epoch import (
    Asked,
    EpochState,
    Verb,
    correct,
    decide,
    filter_epoch,
    program_of,
    refresh,
    score,
    untuned,
)
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.modes import Mode, Tuning
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, MODE, WEIGHTS
from mmwave_env.interface.features import Feature
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import CompiledPolicy, Policy, Rule, policy_from
from mmwave_env.interface.reward import Reward
from mmwave_env.numerics.numbers import Array, Array32, Index
from mmwave_env.numerics.pytree import flatten
from mmwave_env.task import Base
from mmwave_env.world.episode import Episode, EpisodeBatch

SCORED = {"error", "nees", "reward", "reward_terms", "distance"}  # parts from the verb "score"
_CORRECTED = {"x": "reported.x", "P": "reported.P"}  # the belief that a policy has corrected


class Engine(Batch):
    """N tracks of a pipeline.

    Args:
        pipeline: modes and layout.
        n: number of tracks.
        reward: function of (belief, truth); None to compute only errors and NEES.
        observation: kind of observation: "full", "prior" or "signed"; "" if there is no policy, so
            that :meth:`run` filters whole episodes.
        bank: the pipeline's modes and their transition probabilities, if every mode keeps its own
            belief; None if the modes share a belief.
        on_floats: whether to run in plain Python, as filterpy requires, instead of on SIMD lanes.
        threads: maximum number of threads in use; results do not depend on it.
        action: kind of actions (:mod:`mmwave_env.interface.actions`); "" if an IMM gets none.
        rule: function that chooses modes that share a belief; None if actions choose them.
        base: function that makes the agent that trusts modes while the environment's actions
            correct beliefs, given the table of its observations; None if an IMM weighs the modes.
        policy: policy that :meth:`run` asks in every epoch, whose actions are then the kind
            ``action``; None if there is none.

    Attributes:
        observation: table of the observed features, if there are observations.
    """

    observation: Observation

    def __init__(
        self,
        pipeline: Pipeline,
        n: int,
        reward: Reward | None = None,
        observation: str = "full",
        bank: Bank | None = None,
        on_floats: bool = False,
        threads: int = 1,
        action: str = MODE,
        rule: Rule | None = None,
        base: Base | None = None,
        policy: Policy | None = None,
    ) -> None:
        self.pipeline = pipeline
        self.policy = policy
        if policy:
            action = policy.action
            if action != MODE and bank is None:
                raise ValueError(f'policy: found {action} for a shared belief, expected "per-mode"')
        tuned = bank is not None or not observation
        self._asked = Asked(
            untuned(pipeline) if tuned else pipeline,
            bank is not None, observation, reward, action,
            policy is not None or not observation, rule,
        )  # fmt: skip
        self._programs: dict[tuple[Verb, ...], Program[EpochState]] = {}
        verbs = [decide, score, filter_epoch]  # of a step
        if action == CORRECTION:
            verbs = [correct, filter_epoch]
            if base is None:
                verbs += [decide, refresh]
        program = self._program(*verbs)
        at = program.index
        inputs = rows_of([at.action, at.numbers if action != MODE else []])
        shown = rows_of(at.observation)
        super().__init__(program, pipeline.layout, n, inputs, shown, on_floats, threads)
        if observation:
            self.observation = Observation(pipeline, observation, "per-mode" if bank else "shared")
        self._base = policy_from(base(self.observation), "base") if base else None
        if tuned:
            self.tune(bank or [mode.tuning for mode in pipeline.modes])

    def _program(self, *verbs: Verb) -> Program[EpochState]:
        if verbs not in self._programs:
            self._programs[verbs] = program_of(self._asked, verbs)
        return self._programs[verbs]

    def tune(self, tuning: Bank | Sequence[Tuning], places: Places = ALL) -> None:
        """Set the modes' tunings in some tracks, which start over.

        Args:
            tuning: a bank whose modes differ from the pipeline's only in their tuning; or, if the
                modes share a belief and there are no observations, one :class:`Tuning` per mode.
            places: indices of the tracks.
        """
        settings = settings_of(tuning) if isinstance(tuning, Bank) else list(tuning)
        self.write(self.at.settings, np.array(flatten(settings), float), places)
        self.restart(places)

    def show(self, features: Sequence[Feature]) -> None:
        """Observe only these features of the table."""
        names = self.observation.names
        self.observation = self.observation.only(features)
        self.obs_rows = self.obs_rows[[names.index(name) for name in self.observation.names]]

    def restart(self, places: Places) -> None:
        """Start over with the loaded episodes; a policy forgets the past."""
        super().restart(places)
        if self.policy:
            forgets = np.zeros(self.n, np.bool_)
            forgets[places] = True
            self.policy.reset(forgets)

    def run(self, *names: str, actions: NDArray[np.integer[Any]] | None = None) -> dict[str, Array]:
        """Filter the loaded episodes to their ends; with a policy, as :func:`play` does.

        Args:
            names: parts of the :class:`EpochState` to return, such as "x" or "memory.nis".
            actions: (N, epochs) actions; None for zeros.

        Returns:
            For each name, an array: (N, epochs), or (N, epochs, k) if the part has k numbers.
            Values past the end of an episode are meaningless.
        """
        epochs = int(self.state.length.max())
        if self.policy:
            return play(self, self.policy, epochs, names)
        verbs = [filter_epoch, decide]
        if SCORED & set(names):
            verbs.append(score)
        program = self._program(*verbs)
        io = self.io(program.rows(names), epochs)
        if actions is not None:
            io.inputs[..., 0] = actions
        self.advance(io, program=program)
        return program.by_name(names, io.outputs)

    def filter(self) -> Array32:
        """Run all modes on the next epoch of every track; return observations (n, features)."""
        io = self.io()
        self.advance(io, program=self._program(filter_epoch))
        return io.observations[:, 0]

    def decide(
        self, actions: NDArray[Any], output_rows: Index = NO_ROWS, scored: bool = False
    ) -> tuple[Array32, Array]:
        """Turn the results of the modes into beliefs, by actions (n,).

        Args:
            actions: same as in :meth:`step`; or weights of the modes (n, modes).
            output_rows: (k,) indices of the rows to return.
            scored: whether to score the beliefs.

        Returns:
            Observations (n, features), whose columns about the belief after its update are new if
            actions are corrections; and the output rows (n, k).
        """
        verbs = [decide]
        if scored:
            verbs.append(score)
        if self._asked.action == CORRECTION:
            verbs.append(refresh)
        io = self.io(output_rows)
        if self._asked.action == WEIGHTS:
            io.inputs[:, 0, 1:] = actions
        else:
            io.inputs[:, 0, 0] = actions
        self.advance(io, program=self._program(*verbs), again=True)
        return io.observations[:, 0], io.outputs[:, 0]

    def correct(self, numbers: Array, output_rows: Index = NO_ROWS) -> Array:
        """Correct the beliefs of the last decided epoch; return the output rows (n, k).

        Args:
            numbers: (n, 6) shifts and log factors (:mod:`mmwave_env.filters.correction`).
            output_rows: (k,) indices of the rows to return, such as those of "reported".
        """
        io = self.io(output_rows)
        io.inputs[:, 0, 1:] = numbers
        self.advance(io, program=self._program(correct), again=True)
        return io.outputs[:, 0]

    def stages(self, rows: Index) -> Stages:
        """Return the programs of an epoch for a compiled policy; ``rows`` are the output rows."""
        verbs = (filter_epoch,), (decide, refresh), (correct,)
        runs = tuple(self._program(*some).on_lanes() for some in verbs)
        return Stages(runs, self.io(rows), self.program.blank, (self.state, self._same))

    def step(
        self, actions: NDArray[np.integer[Any]] | int = 0, places: Index | None = None
    ) -> Array32:
        """Apply actions (n,), or one action to all; run the modes on the next epoch.

        An environment that was just loaded ignores its action and starts its episode.

        Args:
            actions: numbers of modes, counted from 0; if every mode has its own belief, modes are
                counted from 1, and action 0 leaves all probabilities as they are.
            places: indices of the environments to step; None for all. The others stay unchanged,
                and their results are meaningless.

        Returns:
            The observations (n, features), in a new array.
        """
        io = self.io()
        io.inputs[:, 0, 0] = actions
        self.advance(io, places)
        self.trust(io, places)
        return io.observations[:, 0]

    def trust(self, io: StepIO, places: Index | None = None) -> None:
        """Let the agent ``base``, if there is one, act between filter and decide of a step."""
        if self._base is None:
            return
        n = self.n
        actions: Index = np.asarray(self._base.act(self.read(self.at.observation, np.float32)))
        whole = actions.dtype.kind in "iu"
        count = len(self.observation.actions)
        if not (whole and actions.shape == (n,) and 0 <= actions.min() <= actions.max() < count):
            raise ValueError(
                f"actions of base: found {actions}, expected {n} integers in [0, {count})"
            )
        io.inputs[:, 0, 0] = actions
        decision = io._replace(output_rows=NO_ROWS, outputs=io.outputs[..., :0])
        self.advance(decision, places, self._program(decide, refresh), again=True)

    def observations(self) -> Array32:
        """Return a copy of the current observations (n, features)."""
        return self.read(self.obs_rows, np.float32)


def tracker_of(mode: Mode, episodes: Sequence[Episode], planar: bool = False) -> Engine:
    """Return an engine that has loaded episodes, to filter all of them in one mode."""
    pipeline = Pipeline((mode,), episodes[0].layout, planar)
    tracker = Engine(pipeline, len(episodes), observation="")
    tracker.load(episodes)
    return tracker


def run_imm(
    bank: Bank,
    reward: Reward | None,
    episodes: EpisodeBatch | Sequence[Episode],
    *names: str,
    planar: bool = False,
) -> dict[str, Array]:
    """Filter complete episodes with an IMM, without an agent, starting from the episodes' priors.

    Args:
        bank: the modes and the parameters of their interaction.
        reward: function of (belief, truth), for comparison with policies.
        episodes: n episodes with the same layout.
        names: parts of :class:`EpochState` to return, such as "reward" or "mixture.probability".
        planar: same as in :class:`~mmwave_env.filters.pipeline.Pipeline`.

    Returns:
        The parts, as :meth:`Engine.run` returns them.
    """
    packed = EpisodeBatch.of(episodes)
    pipeline = Pipeline(bank.modes, packed.layout, planar)
    engine = Engine(pipeline, len(packed.length), reward, "", bank, action="")
    engine.load(packed)
    return engine.run(*names)


def play(
    engine: Engine,
    policy: Policy,
    epochs: int,
    names: Sequence[str] = (),
    columns: Index = NO_ROWS,
) -> dict[str, Array]:
    """Play the next epochs of an engine's tracks; each epoch is filtered once.

    Args:
        engine: engine that has loaded the tracks. Its actions are of the policy's kind; if columns
            that describe the belief after its update are recorded, they are corrections.
        policy: policy whose features have been looked up in ``engine.observation``, and that has
            been reset where tracks begin.
        epochs: number T of epochs.
        names: parts of the :class:`EpochState` to record, such as "x" or "memory.nis".
        columns: (c,) indices of the columns of observations to record.

    Returns:
        What :meth:`Engine.run` returns for these names; if the policy corrects beliefs, "x" and "P"
        are the corrected ones, and "trusted" (n, T) are the factors that scaled the corrections.
        "mode" (n, T) are the policy's actions; of weights, the mode that is trusted most. With
        ``columns``, "features" (n, T, c) are their values after every epoch's update.
    """
    n = engine.n
    corrects = policy.action == CORRECTION
    read = [_CORRECTED.get(name, name) if corrects else name for name in names]
    output_rows = engine.program.rows(read)
    scored = bool(SCORED & set(names))
    actions = np.empty((n, epochs), np.int64)
    outputs = np.empty((n, epochs, len(output_rows)))
    features = np.empty((n, epochs, len(columns)), np.float32)
    trusted = np.empty((n, epochs))
    is_played = (
        isinstance(policy, CompiledPolicy)
        and not columns.size
        and policy.play(engine.stages(output_rows), actions, outputs, trusted)
    )
    for t in range(0 if is_played else epochs):
        acted = policy.act(engine.filter())
        actions[:, t] = 1 + acted.argmax(axis=1) if policy.action == WEIGHTS else acted
        if corrects:
            observations, _ = engine.decide(acted)  # the corrected belief is scored instead
            correction = policy.correct(observations)
            assert correction is not None
            numbers = np.concatenate([correction.shift, correction.log_factor], axis=1)
            outputs[:, t] = engine.correct(numbers, output_rows)
            trusted[:, t] = correction.trusted
        else:
            observations, outputs[:, t] = engine.decide(acted, output_rows, scored)
        if columns.size:
            features[:, t] = observations[:, columns]
    parts = engine.program.by_name(read, outputs)
    played: dict[str, Any] = dict(zip(names, parts.values(), strict=True))
    played["mode"] = actions
    if columns.size:
        played["features"] = features
    return played | {"trusted": trusted} if corrects else played
