"""Options of mmwave-loc train."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mmwave_env.reward import TrackingReward


@dataclass(kw_only=True)
class FolderArgs:
    """The run as a folder."""

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


@dataclass(kw_only=True)
class TaskArgs:
    """What is learned."""

    algo: Literal["ppo", "rollouts"] = "ppo"
    """ppo is that of Stable-Baselines3; rollouts is rollout policy iteration with common random
    numbers: every action is tried on the same measurements"""
    scenario: str = "mixed"
    """pedestrian, vehicle, walk-ride, jam, cyclist or mixed (equal shares), or a JSON file;
    or a way of your own, a CSV file with columns t, x, y, z"""
    radio: str = "handset"
    """handset, standard, high or a JSON file: of the street, where no places are named"""
    places: tuple[str, ...] = ()
    """one or more of SCENE:RADIO and SCENE:RADIO:DT in place of a radio, such as street:handset and
    o1:standard:0.1: names or JSON files, and the seconds between epochs, 1 where left out; the
    environments and the episodes that policies are judged on are spread over them evenly"""
    beliefs: Literal["shared", "per-mode"] = "shared"
    """per-mode: every mode keeps its own belief, and the agent says which of them to trust"""
    modes: tuple[str, ...] = ()
    """to choose from: extended, names and mode files; the radio's ekf and ukf by default, and its
    best bank with beliefs per mode"""
    observation: str = "full"
    """full, or prior: nothing of how each mode sees the coming epoch"""
    reward: str = "tracking"
    """tracking or log-score, minus the IMM's where the hyperparameters say paired; or paired, which
    always is tracking minus the IMM's: of the bank, with beliefs per mode"""
    nees_weight: float = TrackingReward.nees_weight
    """weight of the NEES in the tracking reward"""


@dataclass(kw_only=True)
class Args(FolderArgs, TaskArgs):
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
