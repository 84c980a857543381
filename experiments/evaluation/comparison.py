"""Comparison of contenders on the same episodes, with paired differences."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from experiments.console.tables import escaped, grid
from experiments.evaluation.branches import CLAIRVOYANT
from experiments.evaluation.contenders import BEST_IMM, RULE
from experiments.evaluation.intervals import Interval, bootstrap, rounded
from experiments.evaluation.runner import Scores
from experiments.evaluation.seeds import keys_for, named, seeds_from
from mmwave_env.io.files import Json
from mmwave_env.io.lookup import as_cell
from mmwave_env.metrics import HEADERS, METRICS, TERMS
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import EpisodeSource

MISSING = "-"  # what tables show instead of an unknown value


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
    return MISSING if score is None else str(round(score))


@dataclass(frozen=True)
class Comparison:
    """Results of contenders on one source of episodes; ``str`` formats them as Markdown."""

    # scenario, radio and seeds say which episodes were run
    scenario: str
    radio: str
    seeds: Sequence[int]
    policies: dict[str, dict[str, Interval]]  # means by contender and metric
    paired: dict[str, dict[str, Interval]]  # paired differences by "A - B" and metric
    reward: str = "tracking"  # kind of reward in the column "reward"

    @property
    def json(self) -> Json:
        """Return the comparison in the form that results files store."""

        def table(rows: dict[str, dict[str, Interval]]) -> Json:
            return {k: {m: i.json for m, i in row.items()} for k, row in rows.items()}

        tables = {"policies": table(self.policies), "paired": table(self.paired)}
        run = {"episodes": len(self.seeds), "seed": self.seeds[0]}
        return {"scenario": self.scenario, "radio": self.radio, **run, **tables}

    @classmethod
    def from_json(cls, content: Json) -> "Comparison":
        """Return the comparison that a results file stores; contenders are ordered by reward.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: the content is not a comparison.
        """

        def table(key: str) -> dict[str, dict[str, Interval]]:
            rows = content[key].items()
            return {k: {m: Interval.of(i) for m, i in row.items()} for k, row in rows}

        policies = sorted(table("policies").items(), key=lambda row: -row[1]["reward"].mean)
        seeds = seeds_from(content["episodes"], content["seed"], 0)
        names = content["scenario"], content["radio"]
        return cls(*names, seeds, dict(policies), table("paired"))

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
            turned = pair["reward"]
            return Interval(-turned.mean, -turned.high, -turned.low)
        return None

    def __str__(self) -> str:
        """Return a table of the policies' means, then a table of paired reward differences."""
        # Rewards of different kinds are not comparable. So the title names any kind but "tracking".
        reward = "" if self.reward == "tracking" else f", reward {escaped(self.reward)}"
        parts = [
            f"### {escaped(self.scenario)}, {escaped(self.radio)}, {named(self.seeds)}{reward}\n"
        ]
        parts.append(grid(*self.table()))
        if self.paired:
            intervals = ", 95 % intervals" if len(self.seeds) > 1 else ""
            pairs = {f"{a} - {b}": b for a, b in product(self.policies, repeat=2)}
            subtracted = list(dict.fromkeys(pairs[pair] for pair in self.paired))
            rows: list[list[object]] = []
            for name in self.policies:
                gains = (self.paired.get(f"{name} - {reference}") for reference in subtracted)
                rows.append([name, *(gain["reward"] if gain else "" for gain in gains)])
            table = grid(["reward of", *(f"minus {reference}" for reference in subtracted)], rows)
            parts += [f"\nPaired differences of the reward{intervals}:\n", table]
        return "\n".join(parts) + "\n"

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return a header and a row per policy: means ± half the widths of their 95 % intervals.

        If there are scores, the last column has them.
        """
        rows = [[name, *(rounded(row[m]) for m in METRICS)] for name, row in self.policies.items()]
        header = ["policy", *(HEADERS[metric] for metric in METRICS)]
        scores = self.scores
        if scores:
            header.append("score")
            rows = [[*row, score_cell(scores[row[0]])] for row in rows]
        return header, rows


def episodes_csv(scores: dict[str, Scores], seeds: Sequence[int], source: EpisodeSource) -> str:
    """Return a CSV table with a row per contender and episode, and a column per metric.

    A row also has the key of its episode, if the episode is simulated. ``seeds`` and ``source`` say
    which episodes were scored.
    """
    table = io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    columns = (*METRICS, *TERMS)
    rows.writerow(["policy", "seed", "key", *columns])
    keys = keys_for(source, seeds)
    written = [None] * len(seeds) if keys is None else keys.tolist()
    for name, metrics in scores.items():
        values = (metrics[metric].tolist() for metric in columns)
        rows.writerows(zip([as_cell(name)] * len(seeds), seeds, written, *values, strict=True))
    return table.getvalue()


def references(scores: Mapping[str, Scores]) -> list[str]:
    """Return the names of the reference contenders: best fixed mode, paper's rule and IMMs."""
    fixed = [name for name in scores if name.startswith("fixed-")]
    best = max(fixed, key=lambda name: scores[name]["reward"].mean(), default=None)
    return [n for n in (best, RULE, "imm", BEST_IMM) if n is not None and n in scores]


def compare_scores(scores: dict[str, Scores], own: Sequence[str] = (), **more: Any) -> Comparison:
    """Compute intervals of every contender, and paired differences against the references.

    If none of the contenders is a reference, all of them are paired with each other. ``own`` names
    a user's contenders, which are paired with all others, references or not; ``more`` are the
    remaining attributes of :class:`Comparison`.
    """
    metrics = [*METRICS, *TERMS]

    def rows(table: dict[str, Array]) -> dict[str, dict[str, Interval]]:
        intervals = bootstrap(np.concatenate(list(table.values()), axis=1))
        return {
            name: dict(zip(metrics, intervals[i * len(metrics) :], strict=False))
            for i, name in enumerate(table)
        }

    stacked = {name: np.stack([s[m] for m in metrics], axis=1) for name, s in scores.items()}
    pairs = {}
    everyones = references(scores) or list(scores)
    for reference in dict.fromkeys([*everyones, *(scores if own else ())]):
        for name in scores if reference in everyones else own:
            if name != reference:
                pairs[f"{name} - {reference}"] = stacked[name] - stacked[reference]
    paired = rows(pairs) if pairs else {}
    return Comparison(policies=rows(stacked), paired=paired, **more)
