"""Options of mmwave-loc leaderboard."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Args:
    """Judge contenders by the benchmark's protocol, and rank all entries there are.

    Each of them runs in nine places to train in, in unseen ones and on recordings, beside every
    IMM. Its entry, a JSON file, is kept in the folder; the table is made of all that lie there.

    mmwave-loc leaderboard --policies imm-best --episodes 20 --draws 5
    """

    policies: tuple[str, ...] = ()
    """as of mmwave-loc compare; none to show the entries there are"""
    episodes: int = 2000
    """on each simulated street"""
    draws: int = 200
    """of receiver noise on each recording"""
    seed: int = 0
    """seed of the first episode; test seeds start at 0"""
    out: Path = Path("results/leaderboard")
    """folder of entries, a JSON file each"""
    docs: Path | None = None
    """also renew the tables of this page, between its `<!-- table: ... -->` lines"""
