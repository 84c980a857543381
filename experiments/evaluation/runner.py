"""Runs of contenders on the same episodes, and their metrics (protocol: docs/results.md)."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from experiments.console.progress import bars
from experiments.evaluation.agents import NO_FILTERS, Estimator, in_one_line, require_actions
from experiments.evaluation.branches import Clairvoyant
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.seeds import Selection
from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.filters.bank import Modes
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import corrected_all
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.policy import Correction, Policy
from mmwave_env.interface.reward import Reward, TrackingReward, terms_of, total
from mmwave_env.io.lookup import printable
from mmwave_env.metrics import BURN_IN, METRICS, TERMS, scored, summary
from mmwave_env.numerics.linalg import pack, unpack
from mmwave_env.numerics.numbers import Array, Array32
from mmwave_env.task import Task
from mmwave_env.world.episode import Episode, EpisodeBatch, EpisodeSource, columns_of
from mmwave_env.world.simulated import SimulatedSource


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
Scores = dict[str, Array]  # metric -> (episodes,)

# Results of n episodes: "reward" and "nees" (n, T); "error" (n, T, 3); a policy's "mode" (n, T)
EpochResults = dict[str, NDArray[Any]]

PARTS = ("reward", "nees", "error")
BELIEF = ("x", "P")  # parts of the state that a corrector (a policy with "correct") changes
CHUNK = 1000  # maximum number of episodes in memory

Watch = Callable[[Contender, Array, EpochResults], None]


def score(contender: Contender, policy: Policy | None, episodes: Sequence[Episode]) -> Scores:
    """Run a contender and its policy on equally long episodes; return metrics of each episode."""
    results = run_contender(contender, policy, _scorable(episodes))
    return _summary(results, episodes[0].time_s, PLAIN)


def _scorable(episodes: Sequence[Episode]) -> Sequence[Episode]:
    """Return the episodes; refuse episodes without ground truth."""
    for episode in episodes:
        episode.require_truth()
    return episodes


def run_contender(
    contender: Contender,
    policy: Policy | None,
    episodes: EpisodeBatch | Sequence[Episode],
    scoring: Scoring = PLAIN,
    after: Sequence[str] = (),
) -> EpochResults:
    """Run a contender and its policy on equally long episodes; return every epoch's results.

    Args:
        contender, policy: same as in :func:`score`.
        episodes: the episodes; they need ground truth only if ``scoring.planar``.
        scoring: reward and terrain.
        after: names of parts of the filters' state to return for every epoch. All contenders have
            "x" and "P"; all but estimators have "memory.nis", "memory.accepted", "memory.rejected".

    Returns:
        "reward" and "nees" (n, T); "error" (n, T, 3) in m; for a policy also "mode" (n, T), its
        actions; and an array (n, T, values) for each part in ``after``. Without ground truth,
        "reward", "nees" and "error" are NaN.
    """
    if scoring.planar and not isinstance(episodes, EpisodeBatch):
        _scorable(episodes)
    episodes = EpisodeBatch.of(episodes)
    if scoring.planar:
        episodes = episodes.on_flat_ground()
    pipeline = Pipeline(contender.modes, episodes.layout, scoring.planar)
    names = (*PARTS, *after)
    if policy and policy.corrects:
        names = tuple(dict.fromkeys((*names, *BELIEF, "truth")))
    if policy is None:
        return run_imm(contender.bank, scoring.reward, episodes, *names, planar=scoring.planar)
    n, T, _ = episodes.table.shape
    if isinstance(policy, Estimator):
        if not {*after} <= {*BELIEF}:
            raise ValueError(f"policy: found {contender.name}, {NO_FILTERS}")
        x, P = policy.estimate(pipeline, episodes)
        truth = episodes.table[:, :, columns_of(episodes.layout).truth]
        mean = list(np.moveaxis(x, -1, 0))
        packed = list(np.moveaxis(P, -1, 0))
        axes = pipeline.position_axes
        known = pipeline.known_axes
        belief = Belief(mean, unpack(packed, known), axes)
        return {"x": x, "P": P, **_scored(belief, truth, scoring.reward)}
    bank = contender.bank if contender.mixes else None
    engine = Engine(pipeline, n, scoring.reward, contender.observation, bank)
    engine.reset(episodes)
    policy.reset(np.ones(n, bool))
    if isinstance(policy, Clairvoyant):
        policy.foresee(engine)
    program = engine.batch.program
    rows = program.rows(names)
    outputs = np.empty((n, T, len(rows)))
    taken = np.empty((n, T), np.int8)
    corrections: list[Correction] = []
    observations = engine.observations()
    for t in range(T):
        choices = _answer(contender.name, t, policy.act, observations)
        taken[:, t] = actions = require_actions(contender.name, choices, n, len(contender.actions))
        observations, outputs[:, t] = engine.step(actions, rows)
        if policy.corrects:
            corrections.append(_answer(contender.name, t, policy.correct, observations))
    results = program.by_name(names, outputs) | {"mode": taken}
    if policy.corrects:
        results |= _corrected(results, corrections, pipeline, scoring.reward)
    return results


def _answer(name: str, epoch: int, ask: Callable[[Array32], Any], observations: Array32) -> Any:
    """Return a policy's answer to observations (n, features); an error names policy and epoch."""
    try:
        return ask(observations)
    except Exception as error:  # a user's code can raise anything
        raise ValueError(f"policy {name}: {in_one_line(error)}, in epoch {epoch + 1}") from error


def _corrected(
    results: EpochResults, corrections: Sequence[Correction], pipeline: Pipeline, reward: Reward
) -> EpochResults:
    """Correct the belief after every epoch; return the results that depend on the belief."""
    shift, log_factor, trusted = (
        np.stack(parts, axis=1) for parts in zip(*corrections, strict=True)
    )
    belief = corrected_all(results["x"], results["P"], shift, log_factor, pipeline)
    return {
        "x": np.stack(belief.x, axis=-1),
        "P": np.stack(pack(belief.P), axis=-1),
        "trusted": trusted,
        **_scored(belief, results["truth"], reward),
    }


def _scored(belief: Belief, true_states: Array, reward: Reward) -> EpochResults:
    """Score a belief whose components are arrays (n, T), against true states (n, T, 6)."""
    truth = list(np.moveaxis(true_states, -1, 0))
    return {
        "error": np.stack(belief.error(truth), axis=-1),
        "nees": belief.nees(truth),
        "reward": total(terms_of(reward, belief, truth)),
    }


def _epochs_per_second(time_s: Array) -> float:
    """Return the rate of epochs at times (T,), Hz; 1 for an episode of one epoch."""
    return 1.0 / float(np.median(np.diff(time_s))) if len(time_s) > 1 else 1.0


def _warn_of_short(time_s: Array) -> None:
    """Warn if too few epochs are scored for RPE."""
    counted = len(time_s[scored(len(time_s))])
    second = round(_epochs_per_second(time_s))
    if counted <= max(1, second):
        warnings.warn(
            f"episodes of {len(time_s)} epochs: metrics leave out the first {BURN_IN}; "
            f"{counted} are left, but RPE needs more than {max(1, second)}, so RPE is 0",
            stacklevel=3,
        )


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
    return summary(error, nees, _epochs_per_second(time_s), axes, results["reward"]) | {
        name: cost[..., counted].mean(axis=-1) for name, cost in zip(TERMS, costs, strict=True)
    }


def _drawn(selection: Selection, source: EpisodeSource) -> tuple[EpisodeBatch, Array]:
    """Draw equally long episodes, ready to run; also return the first episode's times (T,)."""
    keys = selection.keys(source)
    if keys is None:
        episodes = selection.draw(source)
        return EpisodeBatch.of(_scorable(episodes)), episodes[0].time_s
    simulated = cast(SimulatedSource, source)
    return simulated.sample_batch(keys), simulated.time_s


def score_contenders(
    names: Sequence[str | Contender],
    source: EpisodeSource,
    radio: str,
    selection: Selection,
    modes: Modes = None,
    watch: Sequence[Watch] = (),
    scoring: Scoring = PLAIN,
    after: Sequence[str] = (),
) -> dict[str, Scores]:
    """Compute the scores of contenders on the same episodes.

    Args:
        names: contenders, or their names, which :func:`contender_from` looks up.
        source, selection: source of the episodes, and the seeds of the episodes to run.
        radio, modes: radio profile and modes that :func:`contender_from` gets for each name.
        watch: functions called with a contender, the times (T,) and the contender's epoch results.
        after: parts of the state that epoch results include, as in :func:`run_contender`.

    Raises:
        ValueError: a contender is unknown, or occurs twice.
    """
    chosen = [
        name if isinstance(name, Contender) else contender_from(name, radio, modes)
        for name in names
    ]
    parts: dict[str, list[Scores]] = {contender.name: [] for contender in chosen}
    if len(parts) < len(chosen):
        listed = ", ".join(contender.name for contender in chosen)
        raise ValueError(f"policies: found {listed}, expected different names")
    policies = [contender.start(source.layout, scoring.planar) for contender in chosen]
    with bars() as progress:
        task = progress.add_task(printable(source.name), total=len(selection) * (1 + len(chosen)))
        for first in range(0, len(selection), CHUNK):
            batch, time_s = _drawn(selection.part(first, CHUNK), source)
            count = len(batch.names)
            progress.advance(task, count)
            if not first:
                _warn_of_short(time_s)
            for contender, policy in zip(chosen, policies, strict=True):
                results = run_contender(contender, policy, batch, scoring, after=after)
                _warn_of_nonfinite(contender, results)
                parts[contender.name].append(_summary(results, time_s, scoring))
                for callback in watch:
                    callback(contender, time_s, results)
                progress.advance(task, count)
    return {
        name: {m: np.concatenate([part[m] for part in scores]) for m in (*METRICS, *TERMS)}
        for name, scores in parts.items()
    }
