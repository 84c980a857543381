"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from pathlib import Path

from experiments.arguments.compare import Args
from experiments.cli.main import run
from experiments.cli.options import all_contenders
from experiments.cli.reporting import report, results
from experiments.figures.canvas import require_picture

PICTURES = ("figure", "decisions", "errors", "consistency")


def main(args: Args) -> None:
    """Run the command."""
    pictures = {name: getattr(args, name) for name in PICTURES if getattr(args, name) is not None}
    seen: dict[Path, str] = {}
    for option, path in pictures.items():
        require_picture(option, path)
        if seen.setdefault(path, option) != option:
            raise ValueError(f"{option}: found {path}, expected another file than --{seen[path]}")
    names = args.policies or all_contenders(args)
    report("compare", args, results(args, names, args.bound, **pictures))


if __name__ == "__main__":
    run("compare")
