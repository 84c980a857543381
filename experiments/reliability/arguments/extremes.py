"""Options of mmwave-loc extremes."""

from dataclasses import dataclass

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Run modes of every kind on numbers within the envelope, at its ends and beyond.

    Exits with 1 where a belief within is not finite and positive definite, or a number beyond is
    not refused.

    mmwave-loc extremes --json extremes.json
    """

    epochs: int = 60
    """epochs of a track"""
    seed: int = 3
    """seed of the ordinary episode that is taken to extremes"""
