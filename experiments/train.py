"""mmwave-loc train: switchers that learn, on several training seeds."""

import json
import multiprocessing
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Thread
from typing import Any, Literal

from rich.progress import Progress, TimeElapsedColumn

from experiments.cli import run
from experiments.files import write_bytes, write_json
from experiments.learning.recipe import Recipe, read_recipe, shipped_recipe
from experiments.markdown import grid
from experiments.options import command_line
from mmwave_env.estimator.modes import as_written, modes_from
from mmwave_env.names import choose
from mmwave_env.reward import REWARDS


@dataclass
class Args:
    """Train switchers with PPO; the best policy of every seed, and the median one, are kept."""

    algo: Literal["ppo", "recurrent-ppo"] = "ppo"
    """algorithm of Stable-Baselines3"""
    scenario: str = "mixed"
    """pedestrian, vehicle, walk-ride, jam, cyclist or mixed (equal shares)"""
    radio: str = "handset"
    """handset, standard or high"""
    modes: tuple[str, ...] = ()
    """to choose from: extended, names and mode files; the radio's ekf and ukf by default"""
    observation: str = "full"
    """full, or prior: nothing of how each mode sees the coming epoch"""
    reward: str = "tracking"
    """tracking or log-score"""
    seeds: int = 5
    """how many trainings"""
    total_timesteps: int = 6_000_000
    """epochs to train each for"""
    hyperparameters: Path | None = None
    """a JSON file in place of the algorithm's own, experiments/learning/ppo.json"""
    jobs: int = min(2, os.cpu_count() or 1)
    """how many trainings at once"""
    out: Path = Path("runs/train")
    """folder of the run: a folder a seed, policy.safetensors (the median seed) and summary.json"""
    resume: bool = False
    """go on with the run in this folder, with the options it was started with"""
    overwrite: bool = False
    """replace the run in this folder"""

    def manifest(self) -> dict[str, Any]:
        """What decides how a run goes on."""
        modes = modes_from(self.modes or None, self.radio)
        return {
            "command": command_line("train", replace(self, **ASIDE)),
            "recipe": asdict(self.recipe()), "modes": [as_written(mode) for mode in modes],
        }  # fmt: skip

    def recipe(self) -> Recipe:
        """The hyperparameters."""
        return read_recipe(self.hyperparameters or shipped_recipe(self.algo))


# Options that a policy does not depend on: the command in its file leaves them out.
ASIDE: dict[str, Any] = {
    "jobs": Args.jobs, "out": Args.out, "resume": False, "overwrite": False,
}  # fmt: skip


def begin(args: Args) -> None:
    """Make the folder of a run, or make sure that it holds the one to go on with.

    Raises:
        ValueError: there is a run already; or none to go on with, or another one.
    """
    path, expected = args.out / "run.json", json.loads(json.dumps(args.manifest()))
    if args.resume:
        if not path.is_file():
            raise ValueError(f"out: found no run in {args.out} to resume")
        found = json.loads(path.read_text(encoding="utf-8"))
        for key, value in expected.items():
            if found.get(key) != value:
                raise ValueError(
                    f"{path}: {key}: found {found.get(key)}, expected {value}; resume a run with "
                    "the options it was started with"
                )
        return
    if args.out.exists() and any(args.out.iterdir()):
        if not args.overwrite:
            raise ValueError(
                f"out: found files in {args.out}; --resume goes on with the run there, "
                "--overwrite replaces it, --out names another folder"
            )
        if not path.is_file():
            raise ValueError(f"out: found files in {args.out} that are no run, and left them")
        shutil.rmtree(args.out)
    write_json(path, expected)


def train(job: Any, news: Any) -> dict[str, Any]:
    """One training, in a process of its own; what it has to tell goes into a queue."""
    from experiments.learning.trainer import Training

    if job.outcome.is_file():
        outcome: dict[str, Any] = json.loads(job.outcome.read_text(encoding="utf-8"))
        return outcome
    return Training(job, lambda timesteps, what: news.put((job.seed, timesteps, what))).run()


@contextmanager
def shown(jobs: list[Any]) -> Iterator[Any]:
    """A queue for news of trainings; shown as a bar each, and a line where there is a word."""
    news = multiprocessing.Manager().Queue()
    with Progress(*Progress.get_default_columns(), TimeElapsedColumn(), transient=True) as bar:
        tasks = {job.seed: bar.add_task(f"seed {job.seed}", total=job.timesteps) for job in jobs}

        def show() -> None:
            while (item := news.get()) is not None:
                seed, timesteps, what = item
                bar.update(tasks[seed], completed=timesteps)
                if what:
                    bar.console.print(f"seed {seed}, {timesteps} steps: {what}")

        viewer = Thread(target=show, daemon=True)
        viewer.start()
        yield news
        news.put(None)
        viewer.join()


def summary(outcomes: list[dict[str, Any]]) -> str:
    """All seeds as a Markdown table, best first."""
    rows = []
    for outcome in outcomes:
        best, beat = outcome["best"], outcome["beat_rule"]
        rivals = [best[f"minus {name}"] for name in ("speed-rule", "imm")]
        rows.append([
            str(outcome["seed"]), f"{best['reward']:.4f}", str(best["timesteps"]),
            *(f"{r['mean']:.3f} [{r['ci95'][0]:.3f}, {r['ci95'][1]:.3f}]" for r in rivals),
            f"{beat['seconds']:g} s, {beat['timesteps']} steps" if beat else "never",
            f"{outcome['seconds']:g} s",
        ])  # fmt: skip
    header = [
        "seed",
        "reward",
        "best after",
        "minus speed-rule",
        "minus imm",
        "beat the rule after",
        "time",
    ]
    return grid(header, rows)


def main(args: Args) -> None:
    """Run the command."""
    try:
        from experiments.learning.trainer import Job
        from experiments.learning.world import Task
    except ImportError as error:
        raise ValueError(
            f"train needs more than the base install: {error}; pip install 'mmwave-loc[train]'"
        ) from error
    for name in ("seeds", "total_timesteps", "jobs"):
        if getattr(args, name) < 1:
            raise ValueError(f"{name}: found {getattr(args, name)}, expected 1 or more")
    begin(args)
    modes, command = modes_from(args.modes or None, args.radio), args.manifest()["command"]
    reward = choose(REWARDS, args.reward, "reward")
    task = Task(args.scenario, args.radio, modes, args.observation, reward)
    jobs = [
        Job(
            task,
            args.recipe(),
            args.algo,
            seed,
            args.total_timesteps,
            args.out / f"seed-{seed}",
            command,
        )
        for seed in range(args.seeds)
    ]
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # or the trainings are in each other's way
    spawn = multiprocessing.get_context("spawn")
    with shown(jobs) as news, ProcessPoolExecutor(args.jobs, spawn) as pool:
        outcomes = list(pool.map(train, jobs, [news] * len(jobs)))
    outcomes.sort(key=lambda outcome: -outcome["best"]["reward"])
    median = outcomes[len(outcomes) // 2]
    policy = jobs[median["seed"]].policy
    write_bytes(args.out / "policy.safetensors", policy.read_bytes())
    write_json(
        args.out / "summary.json", args.manifest() | {"seeds": outcomes, "median": median["seed"]}
    )
    print(summary(outcomes))
    print(f"\nthe median seed, {median['seed']}, is {args.out / 'policy.safetensors'}")


if __name__ == "__main__":
    run("train")
