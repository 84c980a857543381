"""Options of mmwave-loc ablate."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments import train


@dataclass(kw_only=True)
class Args:
    """Train with one thing changed at a time, each on several seeds.

    mmwave-loc ablate --variants as-shipped log-score --seeds 2
    """

    variants: tuple[str, ...] = ()
    """which; all where none is named"""
    radio: str = "handset"
    """handset, standard, high or a JSON file"""
    modes: tuple[str, ...] = ()
    """to choose from, as of train"""
    seeds: int = 3
    """trainings of each variant"""
    total_timesteps: int = 1_500_000
    """epochs to train each for"""
    jobs: int = train.Args.jobs
    """how many trainings at once"""
    out: Path = Path("runs/ablation")
    """folder for a run a variant, as train makes it"""
    resume: bool = False
    """go on where the last variant was interrupted"""
