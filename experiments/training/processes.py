"""Trainings side by side, each in a process of its own."""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, cast

from experiments.console.signals import ended_by_signals
from experiments.evaluation.runs import is_number, require_outcome
from experiments.training.hyperparameters import PpoHyperparameters
from experiments.training.job import Job, News, Tell
from experiments.training.ppo import PpoTraining
from experiments.training.rollouts import RolloutTraining
from mmwave_env.files import read_json

Outcome = dict[str, Any]


def train(job: Job[Any], tell: Tell) -> Outcome:
    """Run a training in this process; figures of it and of its best policy.

    Raises:
        ValueError: its checkpoint is damaged.
    """
    if isinstance(job.hyperparameters, PpoHyperparameters):
        return PpoTraining(job, tell).run()
    return RolloutTraining(job, tell).run()


def side_by_side(
    jobs: Sequence[Job[Any]], at_once: int, tell: Callable[[Job[Any], News], None]
) -> list[Outcome]:
    """Run trainings; where one fails or somebody interrupts, the others end, too.

    Args:
        jobs: what to do.
        at_once: how many processes.
        tell: takes a job and what is new of it.

    Returns:
        An outcome for every job.

    Raises:
        ValueError: what a training refused.
        ChildProcessError: a training failed in another way, or was ended from outside.
    """
    waiting, outcomes = list(reversed(jobs)), dict[int, Outcome]()
    running: dict[Any, tuple[Job[Any], BaseProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                job = waiting.pop()
                line, process = _started(job)
                running[line] = job, process
            for ready in wait(list(running)):
                line = cast(Connection, ready)  # wait takes sockets, too
                job, process = running[line]
                try:
                    kind, *told = line.recv()
                except (EOFError, OSError):
                    process.join()
                    raise ChildProcessError(
                        f"seed {job.seed}: its process ended with code {process.exitcode}; "
                        "--resume goes on with the run"
                    ) from None
                if kind == "news":
                    tell(job, News(*told))
                elif kind == "refused":
                    raise ValueError(f"seed {job.seed}: {told[0]}")
                else:
                    (outcomes[job.seed],) = told
                    del running[line]
                    process.join()
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join()
    return [outcomes[job.seed] for job in jobs]


def _started(job: Job[Any]) -> tuple[Connection, BaseProcess]:
    """A process that trains, and the line on which it tells."""
    spawn = multiprocessing.get_context("spawn")  # a fork would share PyTorch's locks
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # or the trainings are in each other's way
    ours, theirs = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_train, args=(job, theirs), daemon=True)
    with _deaf_to_interrupts(), theirs:
        process.start()
    return ours, process


@contextmanager
def _deaf_to_interrupts() -> Iterator[None]:
    """What starts here ignores Ctrl-C: a terminal sends it to all, and one should answer."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _train(job: Job[Any], line: Connection) -> None:
    """One training; ends at its next word when nobody listens any more."""
    try:
        with ended_by_signals():
            if job.outcome.is_file():
                outcome = _outcome(job)
            else:
                outcome = train(job, lambda news: line.send(("news", *news)))
            line.send(("done", outcome))
    except BrokenPipeError:
        return
    except (ValueError, OSError) as error:
        line.send(("refused", str(error)))


def _outcome(job: Job[Any]) -> Outcome:
    """What a training that is over came to, as it wrote it.

    Raises:
        ValueError: something else is in its file.
    """

    def checked(found: Outcome) -> Outcome:
        require_outcome(found)
        if found["seed"] != job.seed:
            raise ValueError(f"seed: found {found['seed']}, expected {job.seed}")
        if not is_number(found["seconds"]):
            raise ValueError(f"seconds: found {found['seconds']!r}, expected a number")
        return found

    return read_json(job.outcome, "the outcome of a training", checked)
