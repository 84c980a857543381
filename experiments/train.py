"""mmwave-loc train: policies that learn to choose filters, with several training seeds."""

from dataclasses import dataclass

from experiments.console.options import TrainArgs


@dataclass(kw_only=True)
class Args(TrainArgs):
    """Train policies that choose filters, with several seeds.

    The best policy of each seed is kept.

        mmwave-loc train --seeds 2 --total-timesteps 500000 --out runs/short
    """


def main(args: Args) -> None:
    """Run the command."""
    from experiments.training.run import train

    train(args)
