"""Options of mmwave-loc studies."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Args:
    """Train with beliefs per mode, briefly and with one thing changed at a time.

    What is recorded in the folder already is left as it is; learned makes the tables.

    mmwave-loc studies --trainings ppo branch
    """

    trainings: tuple[str, ...] = ()
    """which; all where none is named"""
    seeds: int = 1
    """trainings of each but evolution, which has one"""
    total_timesteps: int | None = None
    """to train each for, in place of its own number"""
    evaluations: int = 600
    """of banks without some modes, in tuning them"""
    generations: int = 500
    """of evolution"""
    episodes: int = 2000
    """on test seeds, that defaults is judged on while it is there; others are judged by learned"""
    out: Path = Path("runs/studies")
    """folder for a run each"""
