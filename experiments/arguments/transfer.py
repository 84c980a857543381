"""Options of mmwave-loc transfer."""

from dataclasses import dataclass

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Compare switchers, where they were trained and elsewhere, with what needs no training.

    mmwave-loc transfer --policies ppo --episodes 100 --draws 20
    """

    radio: str = "handset"
    """profile that the switchers were trained with: handset, standard or a JSON file"""
    policies: tuple[str, ...] = ("ppo", "ppo-extended")
    """shipped ones, policy files or folders of runs"""
    episodes: int = 500
    """on each simulated street"""
    draws: int = 100
    """of receiver noise on each recording"""
    seed: int = 0
    """seed of the first episode; test seeds start at 0"""
