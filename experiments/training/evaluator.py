"""Evaluation of the policies of a training run: gains in reward over rivals (a rule and IMMs)."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.console.options import TUNING_SEED
from experiments.evaluation.contenders import contender_from
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.runner import Scores, score
from experiments.evaluation.seeds import draw_episodes
from experiments.training.training_task import Place, TrainingTask
from mmwave_env.io.files import Json
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.world.episode import Episode

TRAINING_RIVALS = ("speed-rule", "imm")  # rivals in every training
PER_MODE_RIVALS = (*TRAINING_RIVALS, "imm-best")  # rivals if every mode keeps its own belief
EPISODES = 500  # number of episodes to evaluate a policy on


class Evaluator:
    """An evaluator that scores all policies on the same episodes, by the default reward.

    Args:
        task: task of the training; episodes are split evenly among its places (scene and radio).
        episodes: number of episodes; every place gets at least one.
    """

    def __init__(self, task: TrainingTask, episodes: int = EPISODES) -> None:
        places = task.places
        numbers = np.arange(max(episodes, len(places)))
        # for each place, the numbers of its episodes, and the episodes
        self._at: list[tuple[Place, Index, Sequence[Episode]]] = []
        for place, here in zip(places, np.array_split(numbers, len(places)), strict=True):
            seeds = (TUNING_SEED + here).tolist()
            self._at.append((place, here, draw_episodes(place.source(task.scenario), seeds)))
        rivals = PER_MODE_RIVALS if task.beliefs == "per-mode" else TRAINING_RIVALS
        # The rule warns at speeds outside its design window, which occur here on purpose.
        with warnings.catch_warnings(action="ignore"):
            self._rivals = {name: self._scores(name)["reward"] for name in rivals}

    def examine(self, path: Path) -> Json:
        """Evaluate a policy file; return results by name.

        The results are the first seed, the number of episodes, the mean of every metric and, as
        "minus NAME", the mean gain in reward over each rival, with a 95 % interval. If there are
        several places, the gain at each place is under "PLACE minus NAME".
        """
        scores = self._scores(str(path))
        differences = {name: scores["reward"] - reward for name, reward in self._rivals.items()}
        figures = _gains(differences)
        if len(self._at) > 1:
            for place, here, _ in self._at:
                gains = _gains({name: values[here] for name, values in differences.items()})
                figures |= {f"{place} {name}": gain for name, gain in gains.items()}
        return {
            "seed": TUNING_SEED,
            "episodes": len(scores["reward"]),
            **{metric: float(values.mean()) for metric, values in scores.items()},
            **{name: gain.json for name, gain in figures.items()},
        }

    def _scores(self, name: str) -> Scores:
        """Score a contender, given its name or file, on all episodes."""
        parts = []
        for place, _, episodes in self._at:
            contender = contender_from(name, place.radio)
            parts.append(score(contender, contender.start(episodes[0].layout), episodes))
        return {metric: np.concatenate([part[metric] for part in parts]) for metric in parts[0]}


def _gains(differences: dict[str, Array]) -> dict[str, Interval]:
    """Return the mean difference from each rival, with an interval, under "minus NAME"."""
    intervals = bootstrap(np.stack(list(differences.values()), axis=1))
    return {f"minus {name}": gain for name, gain in zip(differences, intervals, strict=True)}
