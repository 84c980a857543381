"""mmwave-loc report: one self-contained web page of results."""

from experiments.arguments.report import Args
from experiments.cli.main import run
from experiments.evaluation.terminal import say
from experiments.localize import beginning
from experiments.webpage.episodes import LONGEST
from experiments.webpage.page import write_page
from experiments.webpage.played import Played, arguments_of
from experiments.webpage.source import Source
from experiments.webpage.tracks import shown_track
from mmwave_env.files import require_writable


def localized(source: Source) -> Played:
    """The first epochs of a log, localized again; or why they are not."""
    try:
        args = arguments_of(source)
        if args.imm is None and args.speed is None:
            raise ValueError("its speed was typed on a terminal")
        block, given = beginning(args, LONGEST)
        return shown_track(source.content["log"], given.scene, block, given.plan.modes, given.truth)
    except (ValueError, OSError) as error:
        return Played(missing={"": str(error)})


def main(args: Args) -> None:
    """Run the command."""
    for name in ("episodes", "watch"):
        if getattr(args, name) < 0:
            raise ValueError(f"{name}: found {getattr(args, name)}, expected 0 or more")
    if args.out.suffix != ".html":
        raise ValueError(f"out: found {args.out}, expected a name that ends with .html")
    require_writable(args.out)
    size = write_page(args, localized)
    say(f"{args.out}, {size / 1e6:.1f} MB: open it in a browser")


if __name__ == "__main__":
    run("report")
