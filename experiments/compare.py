"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from dataclasses import dataclass

from experiments.cli import run
from experiments.options import EpisodeArgs, report


@dataclass
class Args(EpisodeArgs):
    """Compare policies on the same seeded episodes."""

    policies: tuple[str, ...] = ()
    """which; all there are by default"""
    bound: bool = False
    """also show each policy's RMSE over the posterior Cramer-Rao bound"""


def main(args: Args) -> None:
    """Run the command."""
    report(args, args.policies or args.contenders(), args.bound)


if __name__ == "__main__":
    run("compare")
