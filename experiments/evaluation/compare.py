"""Comparison of contenders on the same episodes, with paired differences.

:func:`compare` compares a user's agents with known contenders in one call.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments.console.output import csv_text, escaped, grid
from experiments.evaluation.agents import Act
from experiments.evaluation.branches import CLAIRVOYANT
from experiments.evaluation.contenders import (
    BEST_IMM,
    RULE,
    Contender,
    contender_from,
    keys_for,
    named,
    seeds_from,
)
from experiments.evaluation.intervals import Interval, bootstrap, rounded
from experiments.evaluation.runner import AllScores, Scoring, score_contenders
from mmwave_env.filters.bank import Modes
from mmwave_env.interface.reward import reward_name
from mmwave_env.io.files import AnyPath, Json
from mmwave_env.io.lookup import as_cell
from mmwave_env.io.records import require
from mmwave_env.metrics import HEADERS, METRICS
from mmwave_env.numerics.numbers import Array
from mmwave_env.task import Task, task_from
from mmwave_env.world.episode import EpisodeSource


def score_of(gain: float, possible: float) -> float | None:
    """Return a policy's score: 0 is the paper's rule, 100 the clairvoyant (which knows the truth).

    Args:
        gain: the policy's reward minus the rule's reward.
        possible: the clairvoyant's reward minus the rule's reward. If it is not positive, the
            score is None.
    """
    return 100.0 * (gain / possible) if possible > 0.0 else None


def score_cell(score: float | None) -> str:
    """Return a score as tables show it."""
    return "-" if score is None else str(round(score))


Intervals = dict[str, dict[str, Interval]]  # by contender, or by pair "A - B", and by metric


@dataclass(frozen=True)
class Comparison:
    """Results of contenders on one source of episodes; ``str`` formats them as Markdown."""

    # scenario, radio and seeds say which episodes were run
    scenario: str
    radio: str
    seeds: Sequence[int]
    policies: Intervals  # means
    paired: Intervals  # paired differences
    reward: str = "tracking"  # kind of reward in the column "reward"

    @property
    def json(self) -> Json:
        """Return the comparison in the form that results files store."""
        return {
            "scenario": self.scenario,
            "radio": self.radio,
            "episodes": len(self.seeds),
            "seed": self.seeds[0],
            "reward": self.reward,
            "policies": _each(self.policies, lambda interval: interval.json),
            "paired": _each(self.paired, lambda interval: interval.json),
        }

    @classmethod
    def from_json(cls, content: Json) -> "Comparison":
        """Return the comparison that a results file stores; contenders are ordered by reward.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: the content is not a comparison.
        """
        rows = _each(content["policies"], Interval.of)
        policies = dict(sorted(rows.items(), key=lambda row: -row[1]["reward"].mean))
        seeds = seeds_from(content["episodes"], content["seed"])
        return cls(
            content["scenario"],
            content["radio"],
            seeds,
            policies,
            _each(content["paired"], Interval.of),
            content.get("reward", "tracking"),
        )

    @property
    def scores(self) -> dict[str, float | None]:
        """Return every contender's score; return {} if the rule or the clairvoyant is missing."""
        if not {RULE, CLAIRVOYANT} <= self.policies.keys():
            return {}
        rewards = {name: row["reward"].mean for name, row in self.policies.items()}
        possible = rewards[CLAIRVOYANT] - rewards[RULE]
        return {name: score_of(own - rewards[RULE], possible) for name, own in rewards.items()}

    def margin(self, policy: str, other: str) -> Interval | None:
        """Return one policy's reward minus the other's; None if the two are not paired."""
        if pair := self.paired.get(f"{policy} - {other}"):
            return pair["reward"]
        if pair := self.paired.get(f"{other} - {policy}"):
            mean, low, high = pair["reward"]
            return Interval(-mean, -high, -low)
        return None

    def __str__(self) -> str:
        """Return a table of the policies' means, then a table of paired reward differences."""
        # Rewards of different kinds are not comparable. So the title names any kind but "tracking".
        reward = "" if self.reward == "tracking" else f", reward {escaped(self.reward)}"
        title = f"{escaped(self.scenario)}, {escaped(self.radio)}, {named(self.seeds)}{reward}"
        parts = [f"### {title}\n", grid(*self.table())]
        if self.paired:
            names = [*self.policies]
            intervals = ", 95 % intervals" if len(self.seeds) > 1 else ""
            subtracted = [b for b in names if any(f"{a} - {b}" in self.paired for a in names)]
            rows = [
                [
                    name,
                    *(self.paired.get(f"{name} - {b}", {}).get("reward", "") for b in subtracted),
                ]
                for name in names
            ]
            table = grid(["reward of", *(f"minus {reference}" for reference in subtracted)], rows)
            parts += [f"\nPaired differences of the reward{intervals}:\n", table]
        return "\n".join(parts) + "\n"

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return a header and a row per policy: means ± half the widths of their 95 % intervals.

        If there are scores, the last column has them.
        """
        rows = [[name, *(rounded(row[m]) for m in METRICS)] for name, row in self.policies.items()]
        header = ["policy", *(HEADERS[metric] for metric in METRICS)]
        if scores := self.scores:
            header.append("score")
            rows = [[*row, score_cell(scores[row[0]])] for row in rows]
        return header, rows


def _each(table: Json, convert: Callable[[Any], Any]) -> Json:
    """Return a table, by contender or pair and metric, with its values converted."""
    return {name: {m: convert(v) for m, v in row.items()} for name, row in table.items()}


def episodes_csv(scores: AllScores, seeds: Sequence[int], source: EpisodeSource) -> str:
    """Return a CSV table with a row per contender and episode, and a column per metric.

    A row also has the key of its episode, if the episode is simulated. ``seeds`` and ``source`` say
    which episodes were scored.
    """
    rows: list[Sequence[object]] = [["policy", "seed", "key", *HEADERS]]
    keys = keys_for(source, seeds)
    written = [None] * len(seeds) if keys is None else keys.tolist()
    for name, metrics in scores.items():
        values = (metrics[metric].tolist() for metric in HEADERS)
        rows += zip([as_cell(name)] * len(seeds), seeds, written, *values, strict=True)
    return csv_text(rows)


def references(scores: AllScores) -> list[str]:
    """Return the names of the reference contenders: best fixed mode, paper's rule and IMMs."""
    fixed = [name for name in scores if name.startswith("fixed-")]
    best = max(fixed, key=lambda name: scores[name]["reward"].mean(), default=None)
    return [n for n in (best, RULE, "imm", BEST_IMM) if n is not None and n in scores]


def compare_scores(scores: AllScores, own: Sequence[str] = (), **more: Any) -> Comparison:
    """Compute intervals of every contender, and paired differences against the references.

    If none of the contenders is a reference, all of them are paired with each other. ``own`` names
    a user's contenders, which are paired with all others, references or not; ``more`` are the
    remaining attributes of :class:`Comparison`.
    """

    def rows(table: dict[str, Array]) -> Intervals:
        intervals = iter(bootstrap(np.concatenate(list(table.values()))))
        return {name: dict(zip(HEADERS, intervals, strict=False)) for name in table}

    stacked = {name: np.stack([s[m] for m in HEADERS]) for name, s in scores.items()}
    pairs = {}
    everyones = references(scores) or list(scores)
    for reference in dict.fromkeys([*everyones, *(scores if own else ())]):
        for name in scores if reference in everyones else own:
            if name != reference:
                pairs[f"{name} - {reference}"] = stacked[name] - stacked[reference]
    return Comparison(policies=rows(stacked), paired=rows(pairs) if pairs else {}, **more)


def comparison_of(
    task: Task, seeds: Sequence[int], scores: AllScores, own: Sequence[str]
) -> Comparison:
    """Compare scores on a task's episodes with these seeds; see :func:`compare_scores`."""
    return compare_scores(
        scores,
        own,
        scenario=task.source.name,
        radio=task.radio.name,
        seeds=seeds,
        reward=reward_name(task.reward),
    )


Agent = AnyPath | Act


def compare(
    policies: Mapping[str, Agent],
    beside: Sequence[str] = ("fixed-ukf", "speed-rule", "imm"),
    scenario: str | None = None,
    radio: str = "handset",
    episodes: int = 200,
    seed: int = 0,
    modes: Modes = None,
    observation: str = "full",
    data: AnyPath | EpisodeSource | None = None,
    beliefs: str = "shared",
    **world: Any,
) -> Comparison:
    """Compare a user's agents with known contenders on the same episodes.

    Args:
        policies: agents, by the names to show in tables. An agent is either a function that maps
            observations (n, features), float32, of ``n`` episodes to ``n`` integer actions, or
            anything that ``mmwave-loc compare --policies`` accepts: a policy file,
            "module:function", a run's folder, or a contender's name. docs/own-agent.md describes
            the methods (``reset``, ``correct``) and attributes (``modes``, ``observation``,
            ``beliefs``, which override the arguments) that a function may have.
        beside: names of known contenders to compare with, none or several, from
            :func:`~experiments.evaluation.contenders.contenders`.
        scenario, radio: same as in the environment.
        episodes: number of episodes; results to publish need 1000 or more.
        seed: seed of the first episode; training uses seeds from 10 million on.
        modes, observation, beliefs: settings that agents were trained with, as in the environment;
            policy files have their own. An agent given as "imm" is an IMM that mixes these modes;
            a bank or file in ``modes`` also sets its transition probabilities and NIS quantile.
        data: recorded episodes or episodes of your own, as in the environment's ``episodes``.
        world: further arguments of the environment: ``scene``, ``dt``, ``episode_steps``,
            ``planar``, ``odometry``, ``reward``.

    Returns:
        The metrics of all contenders, and paired differences: each of the user's agents against
        every other contender, and the pairs of known contenders that ``mmwave-loc compare`` shows.

    Raises:
        ValueError: an argument is not valid, an agent fails to load, raises, or does not return
            actions. Only agents that fail in an episode raise errors after episodes have run.
        FileNotFoundError: a file that an argument names does not exist.
    """
    _require_valid(policies, episodes, seed, world)
    require("beside", beside, tuple[str, ...])
    if not (policies or beside):
        raise ValueError("policies: found none, expected at least one")
    task = task_from(scenario=scenario, radio=radio, episodes=data, **world)
    scoring = Scoring.of(task)
    seeds = seeds_from(episodes, seed)
    settings = (radio, modes, observation, beliefs)
    everybody = [_contender(name, agent, *settings) for name, agent in policies.items()]
    everybody += [contender_from(name, radio) for name in beside]
    scores = score_contenders(everybody, task.source, seeds, scoring=scoring)
    return comparison_of(task, seeds, scores, list(policies))


def _require_valid(policies: Any, episodes: object, seed: object, world: Mapping[str, Any]) -> None:
    """Refuse arguments of :func:`compare` of a wrong type or name."""
    require("policies", policies, dict)
    require("policies", list(policies), tuple[str, ...])
    require("episodes", episodes, int)
    require("seed", seed, int)
    if wrong := sorted({"action", "base", "terminate_on_divergence"} & world.keys()):
        raise ValueError(f"{wrong[0]}: not an argument of compare, which plays complete episodes")


def _contender(name: str, agent: Agent, *settings: Any) -> Contender:
    """Return the contender of an agent; the settings are radio, modes, observation, beliefs."""
    if isinstance(agent, (str, os.PathLike)):
        return replace(contender_from(os.fspath(agent), *settings), name=name)
    return Contender.own(name, agent, *settings)
