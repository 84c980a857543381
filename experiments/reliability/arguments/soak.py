"""Options of mmwave-loc soak."""

from dataclasses import dataclass

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Run all named modes, mixed, on damaged data; exit with 1 where a number is not sound.

    mmwave-loc soak --steps 1e6 --seed 7
    """

    steps: float = 3e6
    """steps of environments, at least, such as 1e8"""
    seed: int = 0
    """seed of the first episode and of everything else"""
    num_envs: int = 256
    """environments in a batch"""
