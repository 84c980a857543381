"""The train command: the folder of a run, a process for each seed, and the summary."""

import json
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from experiments.console.options import TrainArgs, require_at_least
from experiments.console.output import bars, note, say, show
from experiments.console.provenance import command_line
from experiments.console.signals import heed_signals
from experiments.evaluation.contenders import outcomes_markdown
from experiments.training.corrector import CorrectorTrainer, TwoWayTrainer
from experiments.training.hyperparameters import Hyperparameters, hyperparameters
from experiments.training.ppo import PpoTrainer
from experiments.training.rollouts import RolloutTrainer
from experiments.training.trainer import Job, Tell, Trainer, run_training
from experiments.training.training_task import training_task, with_beliefs
from mmwave_env.filters.bank import Bank, bank_as_written
from mmwave_env.io.files import Json, read_json, write_bytes, write_json

# Default length of a training run, by algorithm: number of steps or, for rollouts, number of states
# in which all actions are tried.
TIMESTEPS = {
    "ppo": 4_000_000,
    "rollouts": 1_200_000,
    "corrector": 110_000_000,
    "two-way": 64_000_000,
}

# Options that do not affect a policy; the command stated in a policy file omits them.
ASIDE = ("jobs", "out", "resume")


def manifest_of(args: TrainArgs, banks: Mapping[str, Bank], hyper: Hyperparameters) -> Json:
    """Return, as JSON, the choices of a run, which may not change when the run is resumed."""
    written = {radio: bank_as_written(bank) for radio, bank in banks.items()}
    first, *_ = written.values()
    choices = {"banks": written} if args.beliefs == "per-mode" else {"modes": first["modes"]}
    command = command_line("train", args, ASIDE)
    figures = json.loads(json.dumps(asdict(hyper)))  # as they will be read: tuples become lists
    return {"command": command, "hyperparameters": figures, **choices}


def begin(args: TrainArgs, manifest: Json) -> None:
    """Make the folder of a run, or check that it holds the run to resume, with the same manifest.

    Raises:
        ValueError: a new run's folder holds files, or there is no such run to resume.
    """
    path = args.out / "run.json"
    if args.resume:
        if not path.is_file():
            raise ValueError(f"out: found no run in {args.out} to resume")
        begun = read_json(path, "the manifest of a run", _flat)
        expected = _flat(manifest)
        for key in expected | begun:
            if begun.get(key) != expected.get(key):
                raise ValueError(
                    f"{path}: {key}: found {begun.get(key)}, expected {expected.get(key)}; resume "
                    "a run with the same options as at its start"
                )
        return
    if args.out.exists() and any(args.out.iterdir()):
        raise ValueError(
            f"out: found files in {args.out}; --resume continues the run there, "
            "--out names another folder"
        )
    write_json(path, manifest)


def _flat(run: Json) -> Json:
    """Return a manifest with one entry per hyperparameter, for a precise message."""
    return {**run, **run["hyperparameters"], "hyperparameters": None}


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
    return run_training(job, TRAINERS[job.hyperparameters.algorithm], tell)


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
                on_interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)  # for the child
                with theirs:
                    child.start()
                signal.signal(signal.SIGINT, on_interrupt)
                running[ours] = job, child
            ready: list[Any] = wait(running)
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
        heed_signals()
        train(job, lambda *news: line.send(news))
    except BrokenPipeError:
        return
    except KeyboardInterrupt as end:
        sys.exit(128 + end.args[0])
    except (ValueError, OSError) as error:
        line.send(str(error))


def run(args: TrainArgs) -> None:
    """Run the command."""
    require_at_least(1, args, "seeds", "total_timesteps", "jobs")
    args = with_beliefs(args)
    task = training_task(args)
    hyper = hyperparameters(args, len(task.places), args.hyperparameters)
    manifest = manifest_of(args, task.banks, hyper)
    steps = args.total_timesteps or TIMESTEPS[args.algo]
    command = manifest["command"]
    jobs = [
        Job(task, hyper, seed, steps, args.out / f"seed-{seed}", command)
        for seed in range(args.seeds)
    ]
    begin(args, manifest)
    with bars() as bar:
        tasks = [bar.add_task(f"seed {job.seed}", total=steps) for job in jobs]

        def tell(job: Job, timesteps: int, text: str) -> None:
            bar.update(tasks[job.seed], completed=timesteps)
            if text:
                bar.console.print(f"seed {job.seed}, {timesteps} steps: {text}", soft_wrap=True)

        try:
            outcomes = side_by_side(jobs, args.jobs, tell)
        except KeyboardInterrupt:
            note(f"repeat the command with --resume to go on with {args.out}")
            raise
    outcomes.sort(key=lambda outcome: -outcome["best"]["reward"])
    median = outcomes[len(outcomes) // 2]
    policy = jobs[median["seed"]].policy
    write_bytes(args.out / "policy.safetensors", policy.read_bytes())
    write_json(args.out / "summary.json", manifest | {"seeds": outcomes, "median": median["seed"]})
    show(outcomes_markdown(outcomes))
    say("", f"{args.out / 'policy.safetensors'} is from the median seed, {median['seed']}")
