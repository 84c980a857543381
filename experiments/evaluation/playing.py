"""Ways to run a contender on episodes: with a policy, or as an estimator."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.agents import NO_FILTERS, Estimator
from experiments.evaluation.branches import Clairvoyant
from mmwave_env.engines.engine import Engine
from mmwave_env.engines.play import play
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, MODE
from mmwave_env.interface.policy import Policy, Switching
from mmwave_env.interface.reward import Reward, TrackingReward, terms_of, total
from mmwave_env.numerics.linalg import unpack
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


def run_policy(
    switching: Switching,
    policy: Policy,
    episodes: EpisodeBatch,
    scoring: Scoring,
    names: Sequence[str],
) -> EpochResults:
    """Play a policy on n episodes of T epochs; return also its actions, "mode" (n, T).

    If the policy corrects beliefs, results are those of the corrected beliefs, and "trusted" (n, T)
    has the factors that scaled the corrections.

    Args:
        switching: the modes, and what the policy observes.
        policy: policy to play; the clairvoyant sees the whole episodes first.
        episodes: the episodes.
        scoring: reward and terrain.
        names: parts of the state to return for every epoch: arrays (n, T, values) by name.
    """
    (n, T, _) = episodes.table.shape
    engine = Engine(
        switching.pipeline(episodes.layout, scoring.planar),
        n,
        scoring.reward,
        switching.observation,
        switching.bank,
        action=CORRECTION if policy.corrects else MODE,
    )
    engine.batch.load(episodes)
    if isinstance(policy, Clairvoyant):
        policy.foresee(engine)
    policy.reset(np.ones(n, bool))
    corrected = {"x": "reported.x", "P": "reported.P"} if policy.corrects else {}
    read = [corrected.get(name, name) for name in names]
    track = play(engine, policy, T, engine.program.rows(read))
    parts = engine.program.by_name(read, track.outputs)
    results: EpochResults = dict(zip(names, parts.values(), strict=True))
    if policy.corrects:
        results["trusted"] = track.trusted
    return results | {"mode": track.actions}


def run_estimator(
    pipeline: Pipeline,
    estimator: Estimator,
    episodes: EpisodeBatch,
    reward: Reward,
    names: Sequence[str],
) -> EpochResults:
    """Run an estimator, which uses no filters; arguments are as in :func:`run_policy`.

    Raises:
        ValueError: a name is neither a score nor a part of the belief.
    """
    x, P = estimator.estimate(pipeline, episodes)
    covariance = unpack(list(np.moveaxis(P, -1, 0)), pipeline.known_axes)
    belief = Belief(list(np.moveaxis(x, -1, 0)), covariance, pipeline.position_axes)
    truth = list(np.moveaxis(episodes.table[:, :, columns_of(episodes.layout).truth], -1, 0))
    results = {
        "x": x,
        "P": P,
        "error": np.stack(belief.error(truth), axis=-1),
        "nees": belief.nees(truth),
        "reward": total(terms_of(reward, belief, truth)),
    }
    if not {*names} <= {*results}:
        raise ValueError(f"policy: found {type(estimator).__name__}, {NO_FILTERS}")
    return results
