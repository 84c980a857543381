"""The train command: the folder of a run, its progress on a terminal, and its summary."""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.progress import TimeElapsedColumn

from experiments.console.options import TaskArgs, TrainArgs, require_at_least
from experiments.console.output import bars, say, show
from experiments.console.provenance import command_line
from experiments.evaluation.contenders import outcomes_markdown
from experiments.training.hyperparameters import (
    Hyperparameters,
    PpoHyperparameters,
    hyperparameters_as_written,
    read_hyperparameters,
    shipped_hyperparameters,
)
from experiments.training.training_task import Place, TrainingTask, banks_of, places_from
from mmwave_env.filters.bank import Bank, bank_as_written
from mmwave_env.interface.reward import REWARDS, PairedReward, Reward, TrackingReward
from mmwave_env.io.files import Json, read_json, write_bytes, write_json
from mmwave_env.io.lookup import choose

# Default length of a training run, by algorithm: number of steps or, for rollouts, number of states
# in which all actions are tried.
TIMESTEPS = {
    "ppo": 4_000_000,
    "rollouts": 1_200_000,
    "corrector": 320_000_000,
    "two-way": 64_000_000,
}

# Options that do not affect a policy; the command stated in a policy file omits them.
ASIDE = ("jobs", "checkpoint_every", "out", "resume", "overwrite")


def rewards(args: TaskArgs) -> Reward:
    """Return a task's reward; if it is paired (agent minus IMM), return the unpaired reward."""
    reward = choose(REWARDS, args.reward, "reward")
    if isinstance(reward, PairedReward):
        reward = reward.reward
    if isinstance(reward, TrackingReward):
        return replace(reward, nees_weight=args.nees_weight)
    return reward


def training_task(args: TaskArgs) -> TrainingTask:
    """Return the training task that options describe.

    Raises:
        ValueError: a place (scene and radio to train at), mode or reward is unknown, a place is
            named twice, or both a radio and places are named.
    """
    places = places_from(args.places) if args.places else (Place("street", args.radio),)
    if args.places and args.radio != TaskArgs.radio:
        raise ValueError("radio: cannot be combined with places, which name their radios")
    banks = banks_of(args.modes, places, args.beliefs)
    return TrainingTask(args.scenario, places, banks, args.observation, rewards(args), args.beliefs)


def hyperparameters(
    args: TaskArgs, places: int, path: Path | None = None, **changed: Any
) -> Hyperparameters:
    """Read the hyperparameters of a training.

    Args:
        args: options of the task.
        places: number of places to train at.
        path: file of hyperparameters; None for the shipped file.
        changed: hyperparameters to change, by name.

    Raises:
        ValueError: the file is for another algorithm, or its number of environments can't be
            divided among the places.
    """
    path = path or shipped_hyperparameters(args.algo, args.beliefs)
    hyper = replace(read_hyperparameters(path, args.algo), **changed)
    together = hyper.together
    if hyper.num_envs % together or hyper.num_envs < together * places:
        multiple = f"a multiple of {together}, " if together > 1 else ""
        raise ValueError(
            f"{path}: num_envs: found {hyper.num_envs}, expected {multiple}{together * places} or "
            f"more for {places} places"
        )
    if isinstance(hyper, PpoHyperparameters):
        return replace(hyper, paired=hyper.paired or args.reward == "paired")
    return hyper  # rollouts compare rewards of actions, so the IMM's reward would cancel out


def manifest_of(args: TrainArgs, banks: Mapping[str, Bank], hyper: Hyperparameters) -> Json:
    """Return, as JSON, the choices of a run, which may not change when the run is resumed."""
    written = {radio: bank_as_written(bank) for radio, bank in banks.items()}
    first, *_ = written.values()
    choices = {"banks": written} if args.beliefs == "per-mode" else {"modes": first["modes"]}
    defaults = {name: getattr(type(args), name) for name in ASIDE}
    command = command_line("train", replace(args, **defaults))
    return {"command": command, "hyperparameters": hyperparameters_as_written(hyper), **choices}


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
        if not args.overwrite:
            raise ValueError(
                f"out: found files in {args.out}; --resume continues the run there, "
                "--overwrite replaces it, --out names another folder"
            )
        if not path.is_file():
            raise ValueError(f"out: found files but no run in {args.out}, and left them there")
        shutil.rmtree(args.out)
    write_json(path, manifest)


def _flat(run: Json) -> Json:
    """Return a manifest with one entry per hyperparameter, for a precise message."""
    return {**run, **run["hyperparameters"], "hyperparameters": None}


def train(args: TrainArgs) -> None:
    """Run the command."""
    try:
        from experiments.training.processes import side_by_side
        from experiments.training.trainer import Job
    except ImportError as error:
        raise ValueError(
            f"train needs more than the base install: {error}; pip install 'mmwave-loc[train]'"
        ) from error
    if args.resume and args.overwrite:
        raise ValueError("overwrite: cannot be combined with resume, which keeps the run")
    require_at_least(1, args, "seeds", "total_timesteps", "jobs", "checkpoint_every")
    if args.algo in ("corrector", "two-way"):
        args = replace(args, beliefs="per-mode")
    task = training_task(args)
    hyper = hyperparameters(args, len(task.places), args.hyperparameters)
    manifest = manifest_of(args, task.banks, hyper)
    steps = args.total_timesteps or TIMESTEPS[args.algo]
    command = manifest["command"]
    jobs = [
        Job(task, hyper, seed, steps, args.out / f"seed-{seed}", command, args.checkpoint_every)
        for seed in range(args.seeds)
    ]
    begin(args, manifest)
    with bars(TimeElapsedColumn()) as bar:
        tasks = [bar.add_task(f"seed {job.seed}", total=steps) for job in jobs]

        def tell(job: Job, timesteps: int, text: str) -> None:
            bar.update(tasks[job.seed], completed=timesteps)
            if text:
                line = f"seed {job.seed}, {timesteps} steps: {text}"
                bar.console.print(line, soft_wrap=True)

        outcomes = side_by_side(jobs, args.jobs, tell)
    outcomes.sort(key=lambda outcome: -outcome["best"]["reward"])
    median = outcomes[len(outcomes) // 2]
    policy = jobs[median["seed"]].policy
    write_bytes(args.out / "policy.safetensors", policy.read_bytes())
    write_json(args.out / "summary.json", manifest | {"seeds": outcomes, "median": median["seed"]})
    show(outcomes_markdown(outcomes))
    say("", f"{args.out / 'policy.safetensors'} is from the median seed, {median['seed']}")
