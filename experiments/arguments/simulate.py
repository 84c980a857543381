"""Options of mmwave-loc simulate."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments.shared import WorldArgs


@dataclass(kw_only=True)
class Args(WorldArgs):
    """Write one episode as a folder: log.csv (measurements), scene.json and truth.tum.

    mmwave-loc simulate --scenario vehicle --out episode
    """

    out: Path
    """the folder"""
    overwrite: bool = False
    """replace the files of an episode that are there"""
    seed: int = 0
    """seed of the episode, the same that evaluate runs"""
    unassociated: bool = False
    """rows are paths in random order, without the number of an anchor; localize --associate reads
    them"""
    false_paths: int = 0
    """drawn among the others in every epoch, with --unassociated"""
