"""Options of mmwave-loc standardize."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Args:
    """Measure what features are standardized by, on training seeds: medians over many tasks.

    A new kind of feature needs a line in the table before it can be measured: mean 0, deviation 1.
    Policy files fit the table they were trained with, and no other.

    mmwave-loc standardize --check
    """

    out: Path = Path("mmwave_env/data/feature_scales.json")
    """the table to write"""
    check: bool = False
    """measure and compare with the table that is used, write nothing"""
    episodes: int = 24
    """simulated episodes of each place and each kind of task"""
