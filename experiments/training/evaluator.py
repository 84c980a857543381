"""Evaluation of a policy during its training, on tuning seeds, against rules and IMMs."""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from itertools import accumulate
from pathlib import Path

import numpy as np

from experiments.console.options import TUNING_SEED
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.runner import Scores, score
from experiments.evaluation.seeds import draw_episodes
from experiments.training.training_task import Place, TrainingTask, shares
from mmwave_env.io.files import Json
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode

TRAINING_RIVALS = ("speed-rule", "imm")  # rivals in every training
PER_MODE_RIVALS = (*TRAINING_RIVALS, "imm-best")  # rivals if every mode keeps its own belief
EPISODES = 500  # number of tuning episodes


class Evaluator:
    """An evaluator that scores all policies on the same tuning episodes, by the default reward.

    Args:
        task: task of the training; its places (scenes with a radio) share the episodes evenly.
        episodes: number of episodes; every place gets at least one.
    """

    def __init__(self, task: TrainingTask, episodes: int = EPISODES) -> None:
        counts = shares(max(episodes, len(task.places)), len(task.places))
        self._at: list[tuple[Place, Sequence[Episode]]] = []
        for place, last, n in zip(task.places, accumulate(counts), counts, strict=True):
            seeds = range(TUNING_SEED + last - n, TUNING_SEED + last)
            self._at.append((place, draw_episodes(place.source(task.scenario), seeds)))
        rivals = PER_MODE_RIVALS if task.beliefs == "per-mode" else TRAINING_RIVALS
        # The rule warns at speeds outside its design window, which occur here on purpose.
        with warnings.catch_warnings(action="ignore"):
            self._rivals = {
                name: self._scores(partial(contender_from, name))["reward"] for name in rivals
            }

    def examine(self, path: Path) -> Json:
        """Return figures of a policy file, by name.

        Returns:
            The mean of every metric over all episodes; under "minus NAME", the gain in reward over
            a rival, with its 95 % interval; if there are several places, also under "PLACE minus
            NAME" the gain at one place; the first seed and the number of episodes.
        """
        scores = self._scores(lambda radio: Contender.learned(path, radio=radio))
        differences = {name: scores["reward"] - reward for name, reward in self._rivals.items()}
        figures = _gains(differences)
        if len(self._at) > 1:
            first = 0
            for place, episodes in self._at:
                here = slice(first, first := first + len(episodes))
                gains = _gains({name: values[here] for name, values in differences.items()})
                figures |= {f"{place} {name}": gain for name, gain in gains.items()}
        return {
            "seed": TUNING_SEED,
            "episodes": len(scores["reward"]),
            **{metric: float(values.mean()) for metric, values in scores.items()},
            **{name: gain.json for name, gain in figures.items()},
        }

    def _scores(self, contender_at: Callable[[str], Contender]) -> Scores:
        """Score a policy or IMM on all episodes; ``contender_at`` makes it for a radio."""
        parts = []
        for place, episodes in self._at:
            contender = contender_at(place.radio)
            parts.append(score(contender, contender.start(episodes[0].layout), episodes))
        return {metric: np.concatenate([part[metric] for part in parts]) for metric in parts[0]}


def _gains(differences: dict[str, Array]) -> dict[str, Interval]:
    """Return intervals of mean differences, each under "minus NAME" with the name of the rival."""
    intervals = bootstrap(np.stack(list(differences.values()), axis=1))
    return {f"minus {name}": gain for name, gain in zip(differences, intervals, strict=True)}
