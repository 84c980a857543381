"""Options of mmwave-loc benchmark."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Measure steps per second, the same work side by side.

    mmwave-loc benchmark --sizes 1 64 1024 --repeats 3
    """

    sizes: tuple[int, ...] = (1, 8, 64, 1024, 16384)
    """numbers of environments in the native vector environment"""
    seconds: float = 0.5
    """time per measurement, at least; whole episodes are measured"""
    repeats: int = 5
    """rounds, in which every workload has its turn; medians and ranges are printed"""
    plot: Path | None = None
    """draw rates and limits to this .png, .svg or .pdf file"""
    docs: Path | None = None
    """also renew the tables of this page, between its `<!-- table: ... -->` lines, and the
    figure beside it"""
