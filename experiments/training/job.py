"""A training to do: what is learned, how, and where everything about it is written."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from experiments.evaluation.seeds import SEEDS_EACH, TRAINING_SEED
from experiments.training.evaluator import EPISODES
from experiments.training.hyperparameters import AnyHyperparameters
from experiments.training.training_task import TrainingTask

Recipe = TypeVar("Recipe", bound=AnyHyperparameters)
Tell = Callable[[int, str], None]  # takes the number of timesteps so far and what is new


@dataclass(frozen=True)
class Job(Generic[Recipe]):
    """One training."""

    # task, recipe: what is learned, and how
    task: TrainingTask
    recipe: Recipe
    algorithm: str  # name
    seed: int  # number of the training, from 0
    # to train for: epochs in all environments together, or states in which all actions are tried
    timesteps: int
    folder: Path  # for all that is written
    command: str  # that makes the policy file
    checkpoint_every: int  # updates between two checkpoints
    episodes: int = EPISODES  # that policies are judged on

    @property
    def outcome(self) -> Path:
        """Figures of the policy; there once the training is over."""
        return self.folder / "outcome.json"

    @property
    def policy(self) -> Path:
        """The best policy so far."""
        return self.folder / "policy.safetensors"

    @property
    def checkpoint(self) -> Path:
        """Where the training stands; there until it is over."""
        return self.folder / "checkpoint.pt"

    @property
    def first_seed(self) -> int:
        """Of the seeds that are the training's own."""
        return TRAINING_SEED + SEEDS_EACH * self.seed


class Trainer(Protocol):
    """A training under way."""

    def run(self) -> dict[str, Any]:
        """Train to the end; figures of the training and of its best policy."""
        ...
