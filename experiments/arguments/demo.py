"""Options of mmwave-loc demo."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Compare every policy on `mixed` and on two ray-traced recordings.

    Six of them are printed; the files have all of them, and every paired difference.

    mmwave-loc demo --episodes 100 --draws 20
    """

    episodes: int = 1000
    """simulated episodes"""
    draws: int = 200
    """draws of receiver noise on each ray-traced scenario"""
    percentiles: bool = False
    """also give percentiles of errors and protection levels, in the files"""
    out: Path = Path("results")
    """folder for tables.md, one JSON file a comparison, and report.html, a web page of them"""
