"""How much a learned switcher owes to the seed of its training (Agarwal et al. 2021).

As in rliable, the interquartile mean and the performance profile are of the matrix of runs and
tasks: here a run is a training, and a task is an episode, the same for all of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.console.tables import grid
from experiments.console.text import escaped
from experiments.evaluation.comparison import references
from experiments.evaluation.intervals import (
    Interval,
    bootstrap,
    crossed_bootstrap,
    interquartile_mean,
    mean,
    share_above,
)
from experiments.evaluation.runner import Scores
from experiments.evaluation.runs import Run
from mmwave_env.numerics.numbers import Array

LEVELS = 81  # of a performance profile


@dataclass(frozen=True)
class Figure:
    """A number per episode, such as the reward, of all trainings of a run."""

    each: tuple[Interval, ...]  # its mean per training, over episodes
    # mean, iqm: mean and interquartile mean over trainings and episodes
    mean: Interval
    iqm: Interval
    levels: Array  # (k,) increasing
    # (3, k) share of pairs of training and episode above each level, and low and high ends of its
    # intervals
    above: Array

    @classmethod
    def of(cls, scores: Array, levels: Array) -> "Figure":
        """From scores (trainings, episodes)."""
        center, iqm, above = crossed_bootstrap(
            scores, mean, interquartile_mean, share_above(levels)
        )
        return cls(
            tuple(bootstrap(scores.T)),
            Interval(*map(float, center)),
            Interval(*map(float, iqm)),
            levels,
            np.clip(above, 0.0, 1.0),
        )

    @property
    def wins(self) -> int:
        """How many trainings have an interval above zero."""
        return sum(interval.low > 0.0 for interval in self.each)

    def json(self, seeds: Sequence[int]) -> dict[str, Any]:
        """As results files hold it."""
        ends = dict(zip(("share", "low", "high"), self.above.tolist(), strict=True))
        return {
            "seeds": {str(s): each.json for s, each in zip(seeds, self.each, strict=True)},
            "above_zero": self.wins,
            "mean": self.mean.json,
            "interquartile_mean": self.iqm.json,
            "profile": {"above": self.levels.tolist(), **ends},
        }


@dataclass(frozen=True)
class TrainingSeeds:
    """A run, and what its trainings gain over others."""

    run: Run  # its trainings
    reward: Figure  # of them
    minus: dict[str, Figure]  # per rival, the reward minus the rival's, episode by episode
    best_imm: str | None  # the IMM with the best reward, or None

    @property
    def json(self) -> dict[str, Any]:
        """As results files hold it."""
        seeds = self.run.seeds
        return {
            "median": self.run.median,
            "best_imm": self.best_imm,
            "reward": self.reward.json(seeds),
            "minus": {rival: figure.json(seeds) for rival, figure in self.minus.items()},
        }


def over_training_seeds(
    runs: Mapping[Run, Sequence[Scores]], scores: dict[str, Scores]
) -> list[TrainingSeeds]:
    """Runs, and what they gain over the contenders that learned switchers are compared with.

    Args:
        runs: scores of every training, in the order of the run.
        scores: of the contenders, on the same episodes.
    """
    rewards = {run: np.stack([s["reward"] for s in trained]) for run, trained in runs.items()}
    baselines = {rival: scores[rival]["reward"] for rival in references(scores)}
    imms = [rival for rival in baselines if rival.startswith("imm")]
    best_imm = max(imms, key=lambda imm: float(baselines[imm].mean()), default=None)

    def figures(differences: dict[Run, Array]) -> dict[Run, Figure]:
        """On common levels, so that profiles can be compared."""
        pooled = np.concatenate([d.ravel() for d in differences.values()])
        low, high = np.percentile(pooled, [1.0, 99.0])
        levels = np.linspace(low, high, LEVELS)
        return {run: Figure.of(d, levels) for run, d in differences.items()}

    reward = figures(rewards)
    minus = {
        rival: figures({run: r - baseline for run, r in rewards.items()})
        for rival, baseline in baselines.items()
    }
    return [
        TrainingSeeds(run, reward[run], {r: table[run] for r, table in minus.items()}, best_imm)
        for run in runs
    ]


def seeds_markdown(found: TrainingSeeds) -> str:
    """A run as Markdown: every training, then all of them."""
    run, columns = found.run, [found.reward, *found.minus.values()]
    best = {found.best_imm: " (best IMM)"}
    header = ["training seed", "reward", *(f"minus {r}{best.get(r, '')}" for r in found.minus)]
    titles = {run.median: f"{run.median} (median)"}
    rows = [
        [titles.get(seed, str(seed)), *(str(column.each[i]) for column in columns)]
        for i, seed in enumerate(run.seeds)
    ]
    wins = [f"{figure.wins} of {len(run.seeds)}" for figure in found.minus.values()]
    rows += [
        ["intervals above zero", "", *wins],
        ["mean over seeds", *(str(column.mean) for column in columns)],
        ["interquartile mean", *(str(column.iqm) for column in columns)],
    ]
    about = (
        f"Over training seeds, {escaped(run.name)}, best on tuning seeds first; 95 % intervals, of "
        "one seed over episodes, of all over seeds and episodes:"
    )
    return f"\n{about}\n\n{grid(header, rows)}\n"
