"""Options of mmwave-loc traffic."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Args:
    """Simulate traffic in a grid of streets with traffic lights and pedestrians, by SUMO.

    What vehicles and pedestrians do goes to a file that --scenario takes.

    mmwave-loc traffic --out traffic.xml.gz --seconds 300 --seed 1
    """

    out: Path
    """file of floating-car data: .xml, .xml.gz, .csv, .csv.gz or .parquet"""
    seconds: float = 300.0
    """how long"""
    step: float = 0.5
    """seconds between positions"""
    seed: int = 0
    """of the traffic"""
    blocks: int = 4
    """blocks from west to east, and from south to north"""
    block_m: float = 80.0
    """distance of parallel streets, m"""
    vehicles: float = 15.0
    """that set off in a minute"""
    pedestrians: float = 15.0
    """that set off in a minute"""
