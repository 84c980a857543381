"""Options of mmwave-loc tables."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Reproduce Tables I, II and III of the paper and test its claims.

    mmwave-loc tables --episodes 100
    """

    episodes: int = 1000
    """simulated episodes for each kind of user and radio"""
    seed: int = 0
    """seed of the first episode; test seeds start at 0"""
    out: Path = Path("results/paper")
    """folder for tables.md, tables.csv and tables.png"""
    docs: Path | None = None
    """also renew the tables of this page, between its `<!-- table: ... -->` lines, and the
    figure beside it"""
