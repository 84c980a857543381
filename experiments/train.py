"""mmwave-loc train: policies that learn to choose filters, with several training seeds."""

from experiments.console.options import TrainArgs as Args


def main(args: Args) -> None:
    """Run the command."""
    try:
        from experiments.training.run import run
    except ImportError as error:
        raise ValueError(
            f"train needs more than the base install: {error}; pip install 'mmwave-loc[train]'"
        ) from error
    run(args)
