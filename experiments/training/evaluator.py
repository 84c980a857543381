"""How good a policy in training is: on tuning seeds, beside those that need no training."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import Scores, score
from experiments.evaluation.seeds import TUNING_SEED, draw_episodes
from experiments.training.training_env import TrainingTask
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import scene_from

TRAINING_RIVALS = ("speed-rule", "imm")
EPISODES = 500


class Evaluator:
    """Scores policies on the same tuning episodes, by the protocol's reward.

    Args:
        task: what is learned.
        episodes: how many.
    """

    def __init__(self, task: TrainingTask, episodes: int = EPISODES) -> None:
        radio = radio_from(task.radio)
        source = SimulatedSource(scene_from("street"), radio, task.scenario)
        self._layout = source.layout
        self._episodes = draw_episodes(source, range(TUNING_SEED, TUNING_SEED + episodes))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the rule leaves its design window is no news
            self._rivals = {
                name: self._score(contender_from(name, radio.name))["reward"]
                for name in TRAINING_RIVALS
            }

    def examine(self, path: Path) -> dict[str, Any]:
        """Figures of a policy file, with 95 % intervals.

        Returns:
            Means of every metric, "modes" (the share of each), and "minus NAME" of every rival.
        """
        scores = self._score(Contender.learned(path))
        differences = np.stack([scores["reward"] - r for r in self._rivals.values()], axis=1)
        pairs = zip(TRAINING_RIVALS, bootstrap(differences), strict=True)
        return {
            "seed": TUNING_SEED, "episodes": len(self._episodes),
            **{metric: float(values.mean()) for metric, values in scores.items()},
            **{f"minus {name}": interval.json for name, interval in pairs},
        }  # fmt: skip

    def _score(self, contender: Contender) -> Scores:
        return score(contender, contender.start(self._layout), self._episodes)
