"""A training to do: what is learned, how, and where everything about it is written."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from experiments.evaluation.seeds import SEEDS_EACH, TRAINING_SEED
from experiments.training.evaluator import EPISODES
from experiments.training.hyperparameters import Hyperparameters
from experiments.training.training_task import TrainingTask

H = TypeVar("H", bound=Hyperparameters)


class News(NamedTuple):
    """What a training tells while it goes on.

    Attributes:
        timesteps: so far.
        text: what happened, in words; mostly nothing.
        evaluation: figures of a periodic evaluation, "reward" among them, by name.
    """

    timesteps: int
    text: str = ""
    evaluation: Mapping[str, float] | None = None


Tell = Callable[[News], None]


@dataclass(frozen=True)
class Job(Generic[H]):
    """One training."""

    # task, hyperparameters: what is learned, and how
    task: TrainingTask
    hyperparameters: H
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
