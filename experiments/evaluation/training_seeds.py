"""Spread of a learned policy's results over training seeds (Agarwal et al. 2021)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.console.tables import escaped, grid
from experiments.evaluation.comparison import references
from experiments.evaluation.intervals import Interval, bootstrap, crossed_bootstrap
from experiments.evaluation.runner import Scores
from experiments.evaluation.runs import Run
from mmwave_env.numerics.numbers import Array


@dataclass(frozen=True)
class Figure:
    """Means of a metric, such as the reward, for all trainings of a run."""

    each: tuple[Interval, ...]  # mean over episodes, for each training
    mean: Interval  # mean over trainings and episodes

    @classmethod
    def of(cls, scores: Array) -> "Figure":
        """Compute means and intervals of scores (trainings, episodes)."""
        return cls(tuple(bootstrap(scores.T)), crossed_bootstrap(scores))

    @property
    def wins(self) -> int:
        """Return the number of trainings whose interval is above zero."""
        return sum(interval.low > 0.0 for interval in self.each)

    def json(self, seeds: Sequence[int]) -> dict[str, Any]:
        """Return the means in the form that results files store."""
        return {
            "seeds": {str(s): each.json for s, each in zip(seeds, self.each, strict=True)},
            "above_zero": self.wins,
            "mean": self.mean.json,
        }


@dataclass(frozen=True)
class TrainingSeeds:
    """A run, with the rewards of its trainings and their gains over rivals."""

    run: Run  # names and outcomes of the trainings
    reward: Figure  # reward of the trainings
    minus: dict[str, Figure]  # difference from each rival's reward, by the rival's name
    best_imm: str | None  # the IMM with the best reward; None if there is no IMM

    @property
    def json(self) -> dict[str, Any]:
        """Return rewards and gains in the form that results files store."""
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
    """Compute rewards of runs, and their gains over the reference contenders among ``scores``.

    ``runs`` maps each run to the scores of its trainings, in the order of the run's seeds; all
    scores are for the same episodes.
    """
    rewards = {run: np.stack([s["reward"] for s in trained]) for run, trained in runs.items()}
    baselines = {rival: scores[rival]["reward"] for rival in references(scores)}
    imms = [rival for rival in baselines if rival.startswith("imm")]
    best_imm = max(imms, key=lambda imm: float(baselines[imm].mean()), default=None)

    return [
        TrainingSeeds(
            run,
            Figure.of(reward),
            {rival: Figure.of(reward - baseline) for rival, baseline in baselines.items()},
            best_imm,
        )
        for run, reward in rewards.items()
    ]


def seeds_markdown(seeds: TrainingSeeds) -> str:
    """Return a run as a Markdown table: every training, then all trainings together."""
    run, columns = seeds.run, [seeds.reward, *seeds.minus.values()]
    best = {seeds.best_imm: " (best IMM)"}
    header = ["training seed", "reward", *(f"minus {r}{best.get(r, '')}" for r in seeds.minus)]
    titles = {run.median: f"{run.median} (median)"}
    rows: list[list[object]] = [
        [titles.get(seed, seed), *(column.each[i] for column in columns)]
        for i, seed in enumerate(run.seeds)
    ]
    wins = [f"{figure.wins} of {len(run.seeds)}" for figure in seeds.minus.values()]
    rows += [
        ["intervals above zero", "", *wins],
        ["mean over seeds", *(column.mean for column in columns)],
    ]
    about = (
        f"Trainings of {escaped(run.name)}, ordered by their rewards on tuning seeds. The 95 % "
        "intervals are over episodes for a seed, and over seeds and episodes for the mean:"
    )
    return f"\n{about}\n\n{grid(header, rows)}\n"
