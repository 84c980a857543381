"""Options of mmwave-loc convert."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(kw_only=True)
class TrainedArgs:
    """What it was trained with."""

    scenario: str = "mixed"
    """kind of user: pedestrian, vehicle, walk-ride, jam, cyclist or mixed"""
    radio: str = "handset"
    """handset, standard, high or a JSON file"""
    modes: tuple[str, ...] = ()
    """modes that it chooses from: extended, names and mode files; the radio's ekf and ukf where
    none is named, with beliefs per mode those of its best IMM"""
    observation: str = "full"
    """full or prior"""
    beliefs: str = "shared"
    """shared or per-mode"""


@dataclass(kw_only=True)
class Args(TrainedArgs):
    """Make a policy file of a model of Stable-Baselines3.

    Loading a model runs code from its file. It is loaded in a process of its own, which is no
    sandbox: convert what you would run. The policy file holds no code, and needs no PyTorch.

    mmwave-loc convert model.zip policy.safetensors --normalize normalize.pkl
    """

    model: Path = field(metadata={"positional": True})
    """file that model.save wrote (.zip), of PPO, A2C, TRPO, MaskablePPO or RecurrentPPO"""
    policy: Path = field(metadata={"positional": True})
    """file to write (.safetensors)"""
    normalize: Path | None = None
    """file that VecNormalize.save wrote, for a model trained under it; loading it runs code, too"""
