"""Options of mmwave-loc association."""

from dataclasses import dataclass

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Hide which path belongs to which anchor, add false ones, and localize beside the labels.

    mmwave-loc association --episodes 50 --false-paths 5
    """

    episodes: int = 50
    """of every kind of user and radio; the shipped logs up to ten times, with other false paths"""
    false_paths: int = 5
    """drawn in every epoch"""
    seed: int = 0
    """seed of the first episode; tuning seeds start at 5000000"""
    imm: bool = False
    """localize by the best IMM instead of the two pipelines"""
