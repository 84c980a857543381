"""Runs of contenders on the same episodes: their metrics, and their histories for pictures.

The protocol is in docs/results.md.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.console.output import tracked
from experiments.evaluation.agents import NO_FILTERS, Estimator
from experiments.evaluation.branches import Clairvoyant
from experiments.evaluation.contenders import Contender, draw_episodes, keys_for
from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.policy import Policy
from mmwave_env.interface.reward import Reward, TrackingReward, terms_of, total
from mmwave_env.metrics import HEADERS, TERMS, scored, summary
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import NO_MODE, POSITION_NUMBERS, History
from mmwave_env.task import Task
from mmwave_env.world.episode import Episode, EpisodeBatch, EpisodeSource, columns_of
from mmwave_env.world.keys import keys_of
from mmwave_env.world.simulated import SimulatedSource

PARTS = ("reward", "nees", "error")
CHUNK = 1000  # maximum number of episodes in memory

# Results of n episodes: "reward" and "nees" (n, T); "error" (n, T, 3); a policy's "mode" (n, T)
EpochResults = dict[str, NDArray[Any]]
Scores = dict[str, Array]  # metric -> (episodes,)
AllScores = dict[str, Scores]  # contender -> its scores on the same episodes


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


PLAIN = Scoring()
Watch = Callable[[Contender, Array, EpochResults], None]


def score(contender: Contender, episodes: Sequence[Episode]) -> Scores:
    """Run a contender on equally long episodes; return metrics of each episode."""
    return _summary(run_contender(contender, _scorable(episodes)), episodes[0].time_s, PLAIN)


def _scorable(episodes: Sequence[Episode]) -> EpisodeBatch:
    """Return a batch of episodes; refuse episodes without ground truth."""
    for episode in episodes:
        episode.require_truth()
    return EpisodeBatch.of(episodes)


def run_contender(
    contender: Contender,
    episodes: EpisodeBatch | Sequence[Episode],
    scoring: Scoring = PLAIN,
    after: Sequence[str] = (),
    policy: Policy | None = None,
) -> EpochResults:
    """Run a contender on equally long episodes; return every epoch's results.

    Args:
        contender: a policy with its modes, or an IMM.
        episodes: the episodes; without ground truth, ``scoring.planar`` keeps the prior's height.
        scoring: reward and terrain.
        after: names of parts of the filters' state to return for every epoch. All contenders have
            "x" and "P"; all but estimators have "memory.nis", "memory.accepted", "memory.rejected".
        policy: the contender's policy; None to start a new one.

    Returns:
        "reward" and "nees" (n, T); "error" (n, T, 3) in m; for a policy also "mode" (n, T), its
        actions; and an array (n, T, values) for each part in ``after``. Without ground truth,
        "reward", "nees" and "error" are NaN. If the policy corrects beliefs, results are those of
        the corrected beliefs, and "trusted" (n, T) has the factors that scaled the corrections.
    """
    batch = EpisodeBatch.of(episodes)
    names = (*PARTS, *after)
    if contender.policy is None:
        assert contender.bank  # an IMM: no policy acts, so one call runs all epochs
        return run_imm(contender.bank, scoring.reward, batch, *names, planar=scoring.planar)
    pipeline = contender.pipeline(batch.layout, scoring.planar)
    policy = policy or contender.start(batch.layout, scoring.planar)
    if isinstance(policy, Estimator):
        return _run_estimator(pipeline, policy, batch, scoring.reward, names)
    engine = Engine(
        pipeline,
        len(batch.length),
        scoring.reward,
        contender.observation,
        contender.bank,
        policy=policy,
    )
    engine.load(batch)
    if isinstance(policy, Clairvoyant):  # it sees the whole episodes first
        policy.foresee(engine)
    return engine.run(*names)


def _run_estimator(
    pipeline: Pipeline,
    estimator: Estimator,
    episodes: EpisodeBatch,
    reward: Reward,
    names: Sequence[str],
) -> EpochResults:
    """Run an estimator, which uses no filters; ``names`` are the results to return.

    Raises:
        ValueError: a name is neither a score nor a part of the belief.
    """
    x, P = estimator.estimate(pipeline, episodes)
    belief = pipeline.belief([*x.T], [*P.T])
    truth = [*episodes.table[:, :, columns_of(episodes.layout).truth].T]
    results = {
        "x": x,
        "P": P,
        "error": np.array(belief.error(truth)).T,
        "nees": belief.nees(truth).T,
        "reward": total(terms_of(reward(belief, truth))).T,
    }
    if not {*names} <= {*results}:
        raise ValueError(f"policy: found {type(estimator).__name__}, {NO_FILTERS}")
    return results


def _warn_of_nonfinite(contender: Contender, results: EpochResults) -> None:
    """Warn if NaN or infinite beliefs make a contender's means NaN; no episode is left out."""
    finite = np.isfinite(results["error"]).all(axis=-1) & np.isfinite(results["nees"])
    lost = np.count_nonzero(~finite.all(axis=1))
    if lost:
        warnings.warn(
            f"{contender.name}: {lost} of {len(finite)} episodes had NaN or infinite beliefs, so "
            "its means over all episodes are NaN (docs/reliability.md)",
            RuntimeWarning,
            stacklevel=3,
        )


def _summary(results: EpochResults, time_s: Array, scoring: Scoring) -> Scores:
    error = results["error"]
    nees = results["nees"]
    axes = 2 if scoring.planar else 3
    reward = scoring.reward if isinstance(scoring.reward, TrackingReward) else TrackingReward()
    costs = reward.costs(np.linalg.norm(error, axis=-1), nees, axes)
    counted = scored(nees.shape[-1])
    hz = 1.0 / float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0
    return summary(error, nees, hz, axes, results["reward"]) | {
        name: cost[..., counted].mean(axis=-1) for name, cost in zip(TERMS, costs, strict=True)
    }


def _drawn(source: EpisodeSource, seeds: Sequence[int]) -> tuple[EpisodeBatch, Array]:
    """Return the episodes of some seeds as a batch, and the times (T,) of their epochs."""
    if type(source) is SimulatedSource:
        return source.sample_batch(keys_of(seeds)), source.time_s
    episodes = draw_episodes(source, seeds)
    return _scorable(episodes), episodes[0].time_s


def score_contenders(
    contenders: Sequence[Contender],
    source: EpisodeSource,
    seeds: Sequence[int],
    watch: Sequence[Watch] = (),
    scoring: Scoring = PLAIN,
    after: Sequence[str] = (),
) -> AllScores:
    """Compute the scores of contenders on the same episodes.

    Args:
        contenders: policies with their modes, or IMMs.
        source, seeds: source of the episodes, and the seeds of the episodes to run.
        watch: functions called with a contender, the times (T,) and the contender's epoch results.
        after: parts of the state that epoch results include, as in :func:`run_contender`.

    Raises:
        ValueError: a contender occurs twice.
    """
    parts: dict[str, list[Scores]] = {contender.name: [] for contender in contenders}
    if len(parts) < len(contenders):
        listed = ", ".join(contender.name for contender in contenders)
        raise ValueError(f"policies: found {listed}, expected different names")
    started = [(c, c.start(source.layout, scoring.planar)) for c in contenders]
    chunks = [seeds[first : first + CHUNK] for first in range(0, len(seeds), CHUNK)]
    for some, (contender, policy) in tracked([*product(chunks, started)], source.name):
        if contender is contenders[0]:  # all contenders play the same episodes, one after another
            batch, time_s = _drawn(source, some)
        results = run_contender(contender, batch, scoring, after, policy)
        _warn_of_nonfinite(contender, results)
        parts[contender.name].append(_summary(results, time_s, scoring))
        for callback in watch:
            callback(contender, time_s, results)
    return {
        name: {m: np.concatenate([part[m] for part in scores]) for m in HEADERS}
        for name, scores in parts.items()
    }


# --- histories, epoch by epoch, for pictures and the player


def history_of(
    contender: Contender, episode: Episode, scoring: Scoring = PLAIN, scene: Scene | None = None
) -> History:
    """Run a contender on an episode with a true track; return its history, from the prior on.

    For a policy, the modes in the history are its actions. For an IMM, they are the most probable
    modes, and the history has the groups of measurements that these modes accepted and rejected.

    Raises:
        ValueError: the policy fails.
    """
    kept = ("x", "P", "memory.accepted", "memory.rejected", "memory.mode")
    results = run_contender(contender, [episode], scoring, kept)
    made = {name: values[0] for name, values in results.items()}
    prior_P = episode.prior_covariance[np.tril_indices(3)]
    truth = episode.table()[:, columns_of(episode.layout).truth]
    pipeline = contender.pipeline(episode.layout, scoring.planar)
    prior_x = pipeline.prior([*episode.prior_mean], [*truth[0]])
    none = np.zeros_like(made["memory.accepted"][0])
    return History(
        episode.name,
        episode.scene_anchors_m,
        scene,
        2 if scoring.planar else 3,
        time_s=_after(0.0, episode.time_s - episode.time_s[0]),
        modes=_after(NO_MODE, made.get("mode", made["memory.mode"])).astype(np.int64),
        truth=_after(truth[0], truth),
        estimate=_after(np.array(prior_x), made["x"]),
        P=_after(prior_P, made["P"][:, :POSITION_NUMBERS]),
        nees=_after(np.nan, made["nees"]),
        accepted=_after(none, made["memory.accepted"]) > 0.5,
        rejected=_after(none, made["memory.rejected"]) > 0.5,
    )


def histories_of(
    task: Task, seeds: Sequence[int], contenders: Sequence[Contender]
) -> Iterator[tuple[Episode, list[History]]]:
    """Draw an episode for each seed; yield it with the history of every contender."""
    scoring = Scoring.of(task)
    for seed in seeds:
        keys = keys_for(task.source, [seed])
        scene = task.scene_of(0 if keys is None else int(keys[0]))
        (episode,) = draw_episodes(task.source, [seed])
        yield episode, [history_of(c, episode, scoring, scene) for c in contenders]


def _after(prior: Array | float, epochs: Array) -> Array:
    """Return rows (T + 1, ...): the prior's row, then the rows of the epochs (T, ...)."""
    return np.concatenate([np.asarray(prior)[None], epochs])
