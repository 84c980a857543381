"""Parallel training runs, each in its own process."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from experiments.console.signals import answered, ended_by_signals
from experiments.training.corrector import CorrectorTrainer, TwoWayTrainer
from experiments.training.ppo import PpoTrainer
from experiments.training.rollouts import RolloutTrainer
from experiments.training.trainer import Job, Tell, Trainer, Training
from mmwave_env.io.files import Json, read_json

TRAINERS: dict[str, Callable[[Job, int], Trainer]] = {
    "ppo": PpoTrainer,
    "rollouts": RolloutTrainer,
    "corrector": CorrectorTrainer,
    "two-way": TwoWayTrainer,
}


def train(job: Job, tell: Tell) -> Json:
    """Run a training in this process; return its outcome.

    Raises:
        ValueError: the checkpoint is damaged.
    """
    return Training(job, TRAINERS[job.hyperparameters.algorithm], tell).run()


def side_by_side(
    jobs: Sequence[Job], at_once: int, tell: Callable[[Job, int, str], None]
) -> list[Json]:
    """Run training jobs in parallel; return their outcomes. If one job fails, end all others.

    Args:
        jobs: training runs.
        at_once: number of processes that run at the same time.
        tell: function that is called with a job, its number of timesteps and a text to print.

    Raises:
        ValueError: the input of a training is not valid.
        ChildProcessError: a training failed in another way, or was ended from outside.
    """
    spawn = multiprocessing.get_context("spawn")  # a fork would share PyTorch's locks
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # otherwise the processes compete for cores
    waiting = [job for job in reversed(jobs) if not job.outcome.is_file()]
    running: dict[Any, tuple[Job, BaseProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                job = waiting.pop()
                ours, theirs = spawn.Pipe(duplex=False)
                child = spawn.Process(target=_train, args=(job, theirs), daemon=True)
                with answered([signal.SIGINT], signal.SIG_IGN), theirs:  # the parent heeds Ctrl-C
                    child.start()
                running[ours] = job, child
            ready: list[Any] = wait(list(running))
            for line in ready:
                job, process = running[line]
                try:
                    message = line.recv()
                except (EOFError, OSError):
                    process.join()
                    if process.exitcode:
                        raise ChildProcessError(
                            f"seed {job.seed}: its process ended with code {process.exitcode}; "
                            "--resume continues the run"
                        ) from None
                    del running[line]
                    continue
                if isinstance(message, str):
                    raise ValueError(f"seed {job.seed}: {message}")
                tell(job, *message)
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join()
    return [read_json(job.outcome, "the outcome of a training", dict) for job in jobs]


def _train(job: Job, line: Connection) -> None:
    """Run one training in this process; end quietly if the parent has closed the connection.

    Messages are the progress, and a text that says why the training was refused.
    """
    try:
        with ended_by_signals():
            train(job, lambda *news: line.send(news))
    except BrokenPipeError:
        return
    except (ValueError, OSError) as error:
        line.send(str(error))
