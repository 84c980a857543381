"""mmwave-loc train: policies that learn to choose filters, with several training seeds."""

from experiments.console.options import TrainArgs as Args


def main(args: Args) -> None:
    """Run the command."""
    from mmwave_env.io.lookup import require_extra

    require_extra("stable_baselines3", "train", "train")
    from experiments.training.run import run

    run(args)
