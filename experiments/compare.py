"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from experiments.arguments.compare import Args
from experiments.cli.main import run
from experiments.cli.options import all_contenders
from experiments.cli.reporting import report, results

PICTURES = ("figure", "decisions", "errors", "consistency", "stanford")


def main(args: Args) -> None:
    """Run the command."""
    pictures = {name: getattr(args, name) for name in PICTURES if getattr(args, name) is not None}
    names = args.policies or all_contenders(args)
    report("compare", args, results(args, names, args.bound, pictures))


if __name__ == "__main__":
    run("compare")
