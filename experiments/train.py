"""mmwave-loc train: policies that learn to choose filters, with several training seeds."""

from experiments.console.options import TrainArgs as Args


def main(args: Args) -> None:
    """Run the command."""
    from experiments.training.run import train

    train(args)
