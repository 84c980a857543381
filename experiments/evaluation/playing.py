"""Ways to run a contender on episodes: with a policy, as an IMM, or as an estimator."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.agents import NO_FILTERS, Estimator
from experiments.evaluation.branches import Clairvoyant
from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.engines.play import play
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, MODE
from mmwave_env.interface.policy import Policy, Switching
from mmwave_env.interface.reward import Reward, TrackingReward, terms_of, total
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array
from mmwave_env.task import Task
from mmwave_env.world.episode import EpisodeBatch, columns_of


class Scoring(NamedTuple):
    """Reward and terrain that apply to all contenders."""

    reward: Reward = TrackingReward()  # function of (belief, truth)
    planar: bool = False  # whether height and vertical speed are known; NEES then covers two axes

    @classmethod
    def of(cls, task: Task) -> "Scoring":
        """Return the scoring of a task; refuse a paired reward."""
        if task.baseline is not None:
            raise ValueError(
                "reward: found a paired reward, expected an unpaired reward; paired differences "
                "between policies, including the IMM, are shown in any case"
            )
        return cls(task.reward, task.pipeline.planar)


# Results of n episodes: "reward" and "nees" (n, T); "error" (n, T, 3); a policy's "mode" (n, T)
EpochResults = dict[str, NDArray[Any]]


class Trial(NamedTuple):
    """A contender's trial on n episodes of T epochs.

    Attributes:
        switching: the modes, and what the policy observes.
        policy: policy to play.
        episodes: the episodes.
        scoring: reward and terrain.
        names: parts of the state to return for every epoch: arrays (n, T, values) by name.
    """

    switching: Switching
    policy: Policy
    episodes: EpisodeBatch
    scoring: Scoring
    names: Sequence[str]

    @property
    def pipeline(self) -> Pipeline:
        """Return the pipeline of the modes."""
        return self.switching.pipeline(self.episodes.layout, self.scoring.planar)

    def begun(self) -> Engine:
        """Return an engine at the beginning of the episodes."""
        switching = self.switching
        n = len(self.episodes.table)
        reward = self.scoring.reward
        action = CORRECTION if self.policy.corrects else MODE
        engine = Engine(
            self.pipeline, n, reward, switching.observation, switching.bank, action=action
        )
        engine.batch.load(self.episodes)
        return engine

    def scores(self, belief: Belief, true_states: Array) -> EpochResults:
        """Score a belief whose components are arrays (n, T), against true states (n, T, 6)."""
        truth = list(np.moveaxis(true_states, -1, 0))
        return {
            "error": np.stack(belief.error(truth), axis=-1),
            "nees": belief.nees(truth),
            "reward": total(terms_of(self.scoring.reward, belief, truth)),
        }


def run_policy(trial: Trial) -> EpochResults:
    """Run a policy; return also its actions, "mode" (n, T).

    If the policy corrects beliefs, results are those of the corrected beliefs, and "trusted" (n, T)
    has the factors that scaled the corrections.
    """
    return _played(trial, trial.begun())


def run_clairvoyant(trial: Trial) -> EpochResults:
    """Run the clairvoyant, which sees the whole episodes first."""
    assert isinstance(trial.policy, Clairvoyant)
    engine = trial.begun()
    trial.policy.foresee(engine)
    return _played(trial, engine)


def run_alone(trial: Trial) -> EpochResults:
    """Run an IMM in one call, because no policy acts."""
    bank = trial.switching.bank
    assert bank
    planar = trial.scoring.planar
    return run_imm(bank, trial.scoring.reward, trial.episodes, *trial.names, planar=planar)


def run_estimator(trial: Trial) -> EpochResults:
    """Run an estimator, which uses no filters.

    Raises:
        ValueError: a part is neither a score nor a part of the belief.
    """
    assert isinstance(trial.policy, Estimator)
    pipeline = trial.pipeline
    x, P = trial.policy.estimate(pipeline, trial.episodes)
    truth = trial.episodes.table[:, :, columns_of(trial.episodes.layout).truth]
    covariance = unpack(list(np.moveaxis(P, -1, 0)), pipeline.known_axes)
    belief = Belief(list(np.moveaxis(x, -1, 0)), covariance, pipeline.position_axes)
    results = {"x": x, "P": P, **trial.scores(belief, truth)}
    if not {*trial.names} <= {*results}:
        raise ValueError(f"policy: found {type(trial.policy).__name__}, {NO_FILTERS}")
    return results


def _played(trial: Trial, engine: Engine) -> EpochResults:
    """Play the episodes that an engine has begun."""
    policy = trial.policy
    corrected = {"x": "reported.x", "P": "reported.P"} if policy.corrects else {}
    names = [corrected.get(name, name) for name in trial.names]
    program = engine.program
    policy.reset(np.ones(engine.batch.n, bool))
    track = play(engine, policy, trial.episodes.table.shape[1], program.rows(names))
    parts = program.by_name(names, track.outputs)
    results: EpochResults = dict(zip(trial.names, parts.values(), strict=True))
    if policy.corrects:
        results["trusted"] = track.trusted
    return results | {"mode": track.actions}
