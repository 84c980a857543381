"""Options of mmwave-loc report."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(kw_only=True)
class Args:
    """One web page of results, which needs neither network nor anything installed.

    Results are JSON files (--json) of compare, evaluate, demo, transfer, localize and learned,
    entries of leaderboard, records of studies, and folders of sweeps and of runs of train. What
    files do not hold epoch by epoch is played again, by the command in them; agents that are code
    of their own (module:function, .zip) are left out there.

    mmwave-loc report results.json runs/train --out report.html
    """

    results: tuple[Path, ...] = field(metadata={"positional": True})
    """JSON files of results, folders of runs, or folders in which such lie"""
    out: Path = Path("report.html")
    """file to write"""
    episodes: int = 30
    """of each comparison to play again, for the distributions of errors and NEES; 0 for none"""
    watch: int = 2
    """how many of these can be watched epoch by epoch"""
