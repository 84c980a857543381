"""Options of mmwave-loc samples."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.arguments.shared import USUAL_EPISODES


@dataclass(kw_only=True)
class Args:
    """List the logs and recordings that come with the package, copy one, or compare on them.

    A log is what a receiver measured; of a recording, every seed draws the noise anew.

    mmwave-loc samples --copy canyon28_vehicle --out ride
    """

    copy: str | None = None
    """the one to copy, by name; needs --out"""
    kind: Literal["log", "recording"] = "log"
    """which of that name"""
    out: Path | None = None
    """the folder for the copy"""
    policies: tuple[str, ...] = ()
    """compare these, as the command compare does, on every recording"""
    episodes: int = USUAL_EPISODES
    """how many of each recording, with --policies"""
