"""Which trainer runs which algorithm."""

from collections.abc import Callable
from typing import Any

from experiments.training.branch import BranchTraining
from experiments.training.job import Job, Tell, Trainer
from experiments.training.ppo import PpoTraining

TRAINERS: dict[str, Callable[[Job[Any], Tell], Trainer]] = {
    "ppo": PpoTraining, "recurrent-ppo": PpoTraining, "branch": BranchTraining,
}  # fmt: skip
