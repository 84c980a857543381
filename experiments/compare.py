"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from dataclasses import dataclass
from pathlib import Path

from experiments.cli.main import run
from experiments.cli.options import EpisodeArgs
from experiments.cli.reporting import report, results
from mmwave_env.files import require_writable


@dataclass
class Args(EpisodeArgs):
    """Compare policies on the same seeded episodes."""

    policies: tuple[str, ...] = ()
    """names, policy files (.safetensors), folders of runs of mmwave-loc train, models of
    Stable-Baselines3 (.zip, with --trust-zip) and module:function, a function without arguments
    that returns an agent; all that have a name by default"""
    bound: bool = False
    """also show each policy's RMSE over the posterior Cramer-Rao bound"""
    figure: Path | None = None
    """draw the performance profiles of runs, over training seeds and episodes, to this .png file"""
    decisions: Path | None = None
    """draw what policies choose around stops and pull-aways, and all errors there, to this .png
    file"""


def main(args: Args) -> None:
    """Run the command."""
    pictures = {"figure": args.figure, "decisions": args.decisions}
    for option, path in pictures.items():
        if path is not None:
            if path.suffix.lower() != ".png":
                raise ValueError(f"{option}: found {path}, expected a name that ends with .png")
            require_writable(path)
    if args.figure is not None and args.figure == args.decisions:
        raise ValueError(f"decisions: found {args.decisions}, expected another file than --figure")
    names = args.policies or args.contenders()
    report(args, results(args, names, args.bound, args.figure, args.decisions))


if __name__ == "__main__":
    run("compare")
