"""Options of mmwave-loc standardize."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Args:
    """Measure what features are standardized by, on training seeds: medians over many tasks.

    A new kind of feature needs a line in the table before it can be measured: mean 0, deviation 1.
    Policy files fit the table they were trained with, and no other: measuring anew, as with other
    banks, makes another environment.

    mmwave-loc standardize --episodes 1 --out table.json
    """

    out: Path = Path("mmwave_env/data/feature_scales.json")
    """the table to write"""
    episodes: int = 24
    """simulated episodes of each place and each kind of task"""
