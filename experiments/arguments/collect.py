"""Options of mmwave-loc collect."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments.shared import ModeArgs
from experiments.evaluation.seeds import TRAINING_SEED


@dataclass(kw_only=True)
class Args(ModeArgs):
    """Keep what policies see, choose and earn as a Minari data set, to learn from it offline.

    All policies play the same episodes in one environment: that of those who were trained, or else
    that of --modes and --beliefs. Needs the extra offline.

    mmwave-loc collect --policies guided imm random --episodes 200 --out datasets
    """

    policies: tuple[str, ...] = ("guided", "imm", "random")
    """who plays: trained ones, as of compare (names, policy files, folders of runs, .zip,
    module:function), and random; beside beliefs per mode imm, who trusts no mode, and trust-NAME,
    who always trusts one; beside a shared belief fixed-NAME, likelihood-rule and, with two modes,
    speed-rule"""
    episodes: int = 200
    """how many each of them plays"""
    seed: int = TRAINING_SEED
    """seed of the first episode; of tests (from 0) and tuning (from 5000000) there are none to
    learn from"""
    reward: str = "tracking"
    """tracking, log-score or paired"""
    id: str = "mmwave-loc/collected-v0"
    """what Minari calls the data set"""
    out: Path | None = None
    """folder of data sets, in which the id is a folder: MINARI_DATASETS_PATH for Minari; where none
    is given, the one that Minari looks in"""
    overwrite: bool = False
    """replace a data set of the same id that this command made"""
