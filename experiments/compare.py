"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from experiments.arguments.compare import Args
from experiments.cli.main import run
from experiments.cli.options import all_contenders
from experiments.cli.pictures import require_picture
from experiments.cli.reporting import report, results


def main(args: Args) -> None:
    """Run the command."""
    pictures = {"figure": args.figure, "decisions": args.decisions}
    for option, path in pictures.items():
        if path is not None:
            require_picture(option, path)
    if args.figure is not None and args.figure == args.decisions:
        raise ValueError(f"decisions: found {args.decisions}, expected another file than --figure")
    names = args.policies or all_contenders(args)
    report("compare", args, results(args, names, args.bound, args.figure, args.decisions))


if __name__ == "__main__":
    run("compare")
