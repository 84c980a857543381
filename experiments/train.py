"""mmwave-loc train: switchers that learn, on several training seeds."""

import os
from dataclasses import dataclass
from pathlib import Path

from experiments.console.options import TaskArgs


@dataclass(kw_only=True)
class Args(TaskArgs):
    """Train switchers; the best policy of every seed, and the median one, are kept.

    mmwave-loc train --seeds 2 --total-timesteps 500000 --out runs/short
    """

    seeds: int = 5
    """how many trainings"""
    total_timesteps: int | None = None
    """epochs to train each for, 4000000 where none is given; with rollouts, states to try every
    action in, 1200000; rounded up to whole updates"""
    hyperparameters: Path | None = None
    """a JSON file in place of the algorithm's own, experiments/training/ppo.json, or
    guided-ppo.json with beliefs per mode"""
    smoke: bool = False
    """one seed and one update, in seconds, to see that all is installed and works: in runs/smoke
    unless --out names another folder; its policy is refused where results are made"""
    jobs: int = min(2, os.cpu_count() or 1)
    """how many trainings at once"""
    checkpoint_every: int = 32
    """updates of a training after which it could go on from where it stands"""
    out: Path = Path("runs/train")
    """folder of the run: a folder a seed, policy.safetensors (the median seed) and summary.json"""
    resume: bool = False
    """go on with the run in this folder, with the options it was started with"""
    overwrite: bool = False
    """replace the run in this folder"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.training.run import train

    train(args)
