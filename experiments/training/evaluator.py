"""Evaluation of the policies of a training run: gains in reward over rivals (a rule and IMMs)."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from experiments.console.options import TUNING_SEED
from experiments.evaluation.contenders import contender_from
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import Scores, score
from experiments.evaluation.seeds import draw_episodes
from experiments.training.training_task import Place, TrainingTask
from mmwave_env.io.files import Json
from mmwave_env.world.episode import Episode

TRAINING_RIVALS = ("speed-rule", "imm")  # rivals in every training
PER_MODE_RIVALS = (*TRAINING_RIVALS, "imm-best")  # rivals if every mode keeps its own belief
EPISODES = 500  # number of episodes to evaluate a policy on


def examiner(task: TrainingTask, episodes: int = EPISODES) -> Callable[[Path], Json]:
    """Return a function that scores policy files on the same episodes, by the default reward.

    Its results are the first seed, the number of episodes, the mean of every metric and, as "minus
    NAME", the mean gain in reward over each rival, with a 95 % interval.

    Args:
        task: task of the training; episodes are split evenly among its places (scene and radio).
        episodes: number of episodes; every place gets at least one.
    """
    places = task.places
    numbers = np.arange(max(episodes, len(places)))
    episodes_at: list[tuple[Place, Sequence[Episode]]] = []
    for place, here in zip(places, np.array_split(numbers, len(places)), strict=True):
        seeds = (TUNING_SEED + here).tolist()
        episodes_at.append((place, draw_episodes(place.source(task.scenario), seeds)))

    def scores_of(name: str) -> Scores:
        """Score a contender, given its name or file, on all episodes."""
        parts = []
        for place, some in episodes_at:
            contender = contender_from(name, place.radio)
            parts.append(score(contender, contender.start(some[0].layout), some))
        return {metric: np.concatenate([part[metric] for part in parts]) for metric in parts[0]}

    rivals = PER_MODE_RIVALS if task.beliefs == "per-mode" else TRAINING_RIVALS
    # The rule warns at speeds outside its design window, which occur here on purpose.
    with warnings.catch_warnings(action="ignore"):
        rewards = {name: scores_of(name)["reward"] for name in rivals}

    def examine(path: Path) -> Json:
        scores = scores_of(str(path))
        differences = {name: scores["reward"] - reward for name, reward in rewards.items()}
        intervals = bootstrap(np.stack(list(differences.values()), axis=1))
        return {
            "seed": TUNING_SEED,
            "episodes": len(scores["reward"]),
            **{metric: float(values.mean()) for metric, values in scores.items()},
            **{
                f"minus {name}": gain.json
                for name, gain in zip(differences, intervals, strict=True)
            },
        }

    return examine
