"""The frame of every training: update, evaluate, log, save; an algorithm is a :class:`Trainer`."""

import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, ClassVar

import numpy as np
import torch

from experiments.console.options import SEEDS_EACH, TRAINING_SEED, TUNING_SEED
from experiments.console.output import csv_text
from experiments.evaluation.contenders import Contender, contender_from, draw_episodes
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import Scores, score
from experiments.training.training_task import TrainingTask
from mmwave_env.interface.observation import Observation
from mmwave_env.io.files import Json, atomic_path, first_line, write_bytes, write_json, write_text
from policies.policy_file import Card, PolicyFile, Tensors, to_bytes, versions_of

RIVALS = ("speed-rule", "imm")  # rivals in every training
EPISODES = 500  # number of episodes to evaluate a policy on


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


State = dict[str, Any]  # numbers, strings and tensors in nested lists and dicts


class Trainer(ABC):
    """An algorithm that trains the network of a policy, update after update.

    Attributes:
        EVERY: number of updates between two evaluations.
        judged: task on which its policies are compared.
        table: features that the network reads.
        base: policy whose beliefs the network corrects; empty if it chooses modes.
        network, optimizers: the network and the optimizers of its weights.
        scales: statistics by which the network's features are normalized.
    """

    EVERY: ClassVar[int]
    judged: TrainingTask
    table: Observation
    base: str = ""
    network: torch.nn.Module
    optimizers: tuple[torch.optim.Optimizer, ...]
    scales: dict[str, Any]

    @abstractmethod
    def update(self, left: float) -> int:
        """Learn from new episodes; return the number of new timesteps.

        Args:
            left: share of the training that is left, 1 at the start.
        """

    @abstractmethod
    def tensors(self) -> Tensors:
        """Return the network in the form that a policy file stores."""

    def examiner(self, episodes: int) -> Callable[[PolicyFile], Json]:
        """Return the function that evaluates the latest policy.

        It scores policies on the same episodes, by the default reward. Its results are the first
        seed, the number of episodes, the mean of every metric and, as "minus NAME", the mean gain
        in reward over each rival, with a 95 % interval.

        Args:
            episodes: number of episodes, split evenly among the places (scene and radio) of
                ``judged``; every place gets at least one.
        """
        task = self.judged
        places = task.places
        seeds = TUNING_SEED + np.arange(max(episodes, len(places)))
        drawn = [
            (place.radio, draw_episodes(place.source(task.scenario), some.tolist()))
            for place, some in zip(places, np.array_split(seeds, len(places)), strict=True)
        ]

        def scores_of(contender: Callable[[str], Contender]) -> Scores:
            """Score a contender, given its function of the radio, on all episodes."""
            parts = [score(contender(radio), some) for radio, some in drawn]
            return {metric: np.concatenate([part[metric] for part in parts]) for metric in parts[0]}

        # if every mode keeps its own belief, the IMM over the same modes is a rival, too
        rivals = (*RIVALS, "imm-best") if task.beliefs == "per-mode" else RIVALS
        # The rule warns at speeds outside its design window, which occur here on purpose.
        with warnings.catch_warnings(action="ignore"):
            rewards = {name: scores_of(partial(contender_from, name))["reward"] for name in rivals}

        def examine(file: PolicyFile) -> Json:
            scores = scores_of(lambda radio: Contender.learned(file, "latest", radio))
            reward = scores["reward"]
            gains = bootstrap([reward - other for other in rewards.values()])
            return {
                "seed": TUNING_SEED,
                "episodes": len(reward),
                **{metric: float(values.mean()) for metric, values in scores.items()},
                **{f"minus {name}": gain.json for name, gain in zip(rewards, gains, strict=True)},
            }

        return examine

    def state(self) -> State:
        """Return the weights, the optimizers and the normalization, for :meth:`restore`."""
        return {
            "network": self.network.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "scales": {name: torch.from_numpy(np.asarray(s)) for name, s in self.scales.items()},
        }

    def restore(self, state: State) -> None:
        """Go on from the weights of a :meth:`state`, with new episodes."""
        self.network.load_state_dict(state["network"])
        for optimizer, part in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(part)
        self.scales.update({name: scale.numpy() for name, scale in state["scales"].items()})


@dataclass
class Progress:
    """The progress of a training, which its checkpoint stores."""

    updates: int = 0
    timesteps: int = 0
    seconds: float = 0.0  # time that it took
    # for each evaluation, a row of the log: timesteps, seconds, and means by name
    log: list[dict[str, float]] = field(default_factory=list)
    best: Json | None = None  # evaluation of the best policy so far, whose file is kept


def run_training(job: Job, algorithm: Callable[[Job, int], Trainer], tell: Tell) -> Json:
    """Run a training to its end; return its outcome, which is also written to a file.

    If the folder of the job has a checkpoint, the training goes on from it.

    Args:
        job: training to run.
        algorithm: function that makes a trainer, given the job and the seed of the first
            environment; the other seeds count up from it.
        tell: function that hears of the progress.

    Raises:
        ValueError: the checkpoint is damaged.
    """
    torch.set_num_threads(1)  # networks this small gain nothing from more threads
    begun_s = time.monotonic()
    progress = Progress()
    state: State | None = None
    if job.checkpoint.exists():
        progress, state = read_checkpoint(job.checkpoint)
        begun_s -= progress.seconds
    # after an interruption, the environments get new episodes
    new = progress.updates * job.hyperparameters.num_envs
    trainer = algorithm(job, TRAINING_SEED + SEEDS_EACH * job.seed + new)
    if state is not None:
        with going_on_from(job.checkpoint):
            trainer.restore(state)
    examine = trainer.examiner(job.episodes)

    def keep() -> None:
        with atomic_path(job.checkpoint) as temporary:
            torch.save({"progress": vars(progress), "trainer": trainer.state()}, temporary)

    try:
        while progress.timesteps < job.timesteps:
            progress.timesteps += trainer.update(1.0 - progress.timesteps / job.timesteps)
            progress.updates += 1
            progress.seconds = time.monotonic() - begun_s
            text = ""
            if progress.timesteps >= job.timesteps or progress.updates % trainer.EVERY == 0:
                reward = judge(job, trainer, progress, examine)
                text = f"reward {reward:.3f}"
                keep()
            tell(progress.timesteps, text)
    finally:  # also after a signal
        if progress.updates:
            keep()
    outcome = {
        "seed": job.seed,
        "timesteps": progress.timesteps,
        "seconds": round(time.monotonic() - begun_s, 1),
        "best": progress.best,
    }
    write_json(job.outcome, outcome)
    job.checkpoint.unlink(missing_ok=True)
    return outcome


def judge(
    job: Job, trainer: Trainer, progress: Progress, examine: Callable[[PolicyFile], Json]
) -> float:
    """Evaluate and log the latest policy; keep it if it is the best so far; return its reward."""
    file = PolicyFile(trainer.tensors(), card_of(job, trainer, progress.timesteps), job.policy)
    results = examine(file)
    if progress.best is None or not results["reward"] <= progress.best["reward"]:
        progress.best = {"timesteps": progress.timesteps, **results}
        card = replace(file.card, evaluation=progress.best)
        write_bytes(job.policy, to_bytes(file.tensors, card))
    row = {"timesteps": progress.timesteps, "seconds": progress.seconds}
    for name, value in results.items():
        row[f"tuning/{name}"] = float(value["mean"] if isinstance(value, dict) else value)
    progress.log.append(row)
    table = [row, *(logged.values() for logged in progress.log)]
    write_text(job.folder / "progress.csv", csv_text(table))
    return row["tuning/reward"]


def card_of(job: Job, trainer: Trainer, timesteps: int) -> Card:
    """Return the card of a trainer's policy, without an evaluation."""
    table = trainer.table
    task = job.task
    return Card(
        modes=table.modes,
        observation=table.kind,
        features=table.columns,
        scenario=task.scenario,
        radio=", ".join(task.banks),
        algorithm=job.hyperparameters.algorithm,
        seed=job.seed,
        timesteps=timesteps,
        command=job.command,
        evaluation={},
        versions=versions_of("gymnasium", "numpy", "numba", "torch", "stable-baselines3"),
        beliefs=table.beliefs,
        banks=dict(task.banks) if table.beliefs == "per-mode" else {},
        base=trainer.base,
    )


def read_checkpoint(path: Path) -> tuple[Progress, State]:
    """Read a checkpoint: progress, and state of the trainer.

    Raises:
        ValueError: the file is damaged; nothing in it is executed.
    """
    with going_on_from(path):
        saved = torch.load(path, map_location="cpu", weights_only=True)
        return Progress(**saved["progress"]), saved["trainer"]


@contextmanager
def going_on_from(path: Path) -> Iterator[None]:
    """Turn any exception into a ValueError while a training goes on from a checkpoint.

    PyTorch can raise any exception for damaged bytes.

    Raises:
        ValueError: an exception was raised; the message names the checkpoint's file.
    """
    try:
        yield
    except Exception as error:
        reason = first_line(error)
        if isinstance(error, UnpicklingError):  # PyTorch's text advises to load it unsafely
            reason = "found damaged content"
        raise ValueError(
            f"{path}: not a checkpoint: {reason}; remove it to train from the start"
        ) from error
