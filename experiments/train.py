"""mmwave-loc train: policies that learn to choose filters, with several training seeds."""

import os
from dataclasses import dataclass
from pathlib import Path

from experiments.console.options import TaskArgs


@dataclass(kw_only=True)
class Args(TaskArgs):
    """Train policies that choose filters, with several seeds.

    The best policy of each seed is kept.

        mmwave-loc train --seeds 2 --total-timesteps 500000 --out runs/short
    """

    seeds: int = 5
    """number of training runs, one per seed"""
    total_timesteps: int | None = None
    """length of each training run, rounded up to complete
    updates: for --algo ppo or corrector, the number of
    steps of environments (None: 4000000 for ppo,
    320000000 for corrector); for --algo rollouts, the
    number of states in which every action is tried
    (None: 1200000)"""
    hyperparameters: Path | None = None
    """JSON file of hyperparameters, instead of the
    algorithm's default file in experiments/training, such
    as ppo.json or, with --beliefs per-mode,
    guided-ppo.json"""
    jobs: int = min(2, os.cpu_count() or 1)
    """number of training runs in parallel"""
    checkpoint_every: int = 32
    """number of updates between two checkpoints; --resume
    continues from the last checkpoint"""
    out: Path = Path("runs/train")
    """output folder: one folder per seed, policy.safetensors
    (from the seed with the median reward) and summary.json"""
    resume: bool = False
    """continue the training in the folder --out; the options
    must be the same as at its start"""
    overwrite: bool = False
    """replace the training in the folder --out"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.training.run import train

    train(args)
