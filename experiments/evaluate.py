"""mmwave-loc evaluate: one policy, its metrics with 95 % intervals."""

from experiments.arguments.evaluate import Args
from experiments.cli.main import run
from experiments.cli.reporting import report, results


def main(args: Args) -> None:
    """Run the command."""
    pictures = {"stanford": args.stanford} if args.stanford else {}
    report("evaluate", args, results(args, [args.policy], pictures=pictures))


if __name__ == "__main__":
    run("evaluate")
