"""Specification of a training, and of the files that it writes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.training.evaluator import EPISODES
from experiments.training.training_task import TrainingTask

# a function that hears of a training's progress: its number of timesteps so far, and a text to
# print, which is mostly empty
Tell = Callable[[int, str], None]


@dataclass(frozen=True)
class Job:
    """A training to run."""

    task: TrainingTask
    hyperparameters: Any  # hyperparameters of the algorithm
    seed: int  # training seed; a run numbers its trainings from 0
    # length of the training: number of environment steps, summed over all environments; for the
    # algorithm "rollouts", number of states in which all actions are tried
    timesteps: int
    folder: Path  # folder for all files of the training
    command: str  # command that the policy file records as its origin
    checkpoint_every: int  # number of updates between two checkpoints
    episodes: int = EPISODES  # number of episodes to judge policies on

    @property
    def outcome(self) -> Path:
        """Return the file of the outcome, which exists once the training is finished."""
        return self.folder / "outcome.json"

    @property
    def policy(self) -> Path:
        """Return the file of the best policy so far."""
        return self.folder / "policy.safetensors"

    @property
    def checkpoint(self) -> Path:
        """Return the file of the latest checkpoint, which is deleted when the training finishes."""
        return self.folder / "checkpoint.pt"
