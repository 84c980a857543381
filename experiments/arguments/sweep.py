"""Options of mmwave-loc sweep."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal


@dataclass(kw_only=True)
class Args:
    """Grids of policies, users, radios, scenes, seeds and hyperparameters, cell by cell.

    The file says what is to be done (docs/sweep.md). What is there is not computed again: a sweep
    that was ended goes on. Cells that fail are told at the end; the others are whole.

    mmwave-loc sweep grid.toml --out sweeps
    """

    spec: Path = field(metadata={"positional": True})
    """TOML file: [evaluate] and [train], whose lists are combined, or [search], by Ray alone"""
    out: Path = Path("sweeps")
    """folder of the data set: Parquet, a folder a run, a row an episode"""
    engine: Literal["local", "ray"] = "local"
    """processes of this machine, or Ray"""
    address: str | None = None
    """of a Ray cluster: auto, or HOST:PORT; this machine alone, where none is given"""
    workers: int = os.cpu_count() or 1
    """how many cells at once, without an address"""
    tries: int = 2
    """of a cell before it has failed"""
