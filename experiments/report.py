"""mmwave-loc report: one self-contained web page of results."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

if TYPE_CHECKING:
    from experiments.webpage.played import Played
    from experiments.webpage.source import Source


@dataclass(kw_only=True)
class Args:
    """One web page of results, which needs neither network nor anything installed.

    Results are JSON files (--json) of compare, evaluate, demo, transfer, localize and learned,
    entries of leaderboard, records of studies, and folders of sweeps and of runs of train. What
    files do not hold epoch by epoch is played again, by the command in them; agents that are code
    of their own (module:function, .zip) are left out there.

    mmwave-loc report results.json runs/train --out report.html
    """

    results: Positional[tuple[Path, ...]]
    """JSON files of results, folders of runs, or folders in which such lie"""
    out: Path = Path("report.html")
    """file to write"""
    episodes: int = 30
    """of each comparison to play again, for the distributions of errors and NEES; 0 for none"""
    watch: int = 2
    """how many of these can be watched epoch by epoch"""


def localized(source: "Source") -> "Played":
    """The first epochs of a log, localized again; or why they are not."""
    from experiments.localization.algorithm import beginning
    from experiments.webpage.episodes import LONGEST
    from experiments.webpage.played import Played, arguments_of
    from experiments.webpage.tracks import shown_track

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
    from experiments.console.progress import say
    from experiments.webpage.page import write_page
    from mmwave_env.files import require_writable

    for name in ("episodes", "watch"):
        if getattr(args, name) < 0:
            raise ValueError(f"{name}: found {getattr(args, name)}, expected 0 or more")
    if args.out.suffix != ".html":
        raise ValueError(f"out: found {args.out}, expected a name that ends with .html")
    require_writable(args.out)
    size = write_page(args, localized)
    say(f"{args.out}, {size / 1e6:.1f} MB: open it in a browser")
