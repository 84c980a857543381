"""mmwave-loc evaluate: one policy, its metrics with 95 % intervals."""

from experiments.arguments.evaluate import Args
from experiments.cli.main import run
from experiments.cli.reporting import report, results


def main(args: Args) -> None:
    """Run the command."""
    report("evaluate", args, results(args, [args.policy]))


if __name__ == "__main__":
    run("evaluate")
