"""mmwave-loc report: one self-contained web page of results."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

if TYPE_CHECKING:
    from experiments.webpage.played import Played
    from experiments.webpage.sources import Source


@dataclass(kw_only=True)
class Args:
    """One web page of results, which needs neither network nor anything installed.

    It says who won by how much, and has tables, distributions of errors (CDF) and episodes to
    play. Results are JSON files (--json) of compare, demo and localize, and folders of runs of
    train. What files do not hold epoch by epoch is played again, by the command in them; agents
    that are code of their own (module:function) are left out there.

    mmwave-loc report results.json runs/train --out report.html
    """

    results: Positional[tuple[Path, ...]]
    """JSON files of results, and folders of runs"""
    out: Path = Path("report.html")
    """file to write"""
    episodes: int = 30
    """of each comparison to play again, for the distributions of errors and NEES; 0 for none"""
    watch: int = 2
    """how many of these can be watched epoch by epoch"""


def localized(source: "Source") -> "Played":
    """Localize the first epochs of a log again for the player, or say why that failed."""
    import numpy as np

    from experiments.localization.algorithm import beginning
    from experiments.webpage.played import LONGEST, Played, arguments_of, course, scenery
    from mmwave_env.filters.bank import Bank
    from mmwave_env.filters.belief import Belief
    from mmwave_env.filters.pipeline import VERTICAL
    from mmwave_env.numerics.linalg import unpack

    try:
        args = arguments_of(source)
        block, work = beginning(args, LONGEST)
    except (ValueError, OSError) as error:
        return Played(missing={"": str(error)})
    axes = (0, 1) if block.planar else (0, 1, 2)
    known = np.full((len(block), 3), np.nan)
    if work.truth:
        known = work.truth.at(block.time_s).position_m
    zero = VERTICAL if block.planar else ()
    belief = Belief([*block.x.T], unpack([*block.P.T], zero=zero), axes)
    told = {
        "x": block.x,
        "P": block.P,
        "error": block.x[:, :3] - known,
        "nees": np.asarray(belief.nees([*known.T])),
        "memory.mode": block.mode,
        "memory.nis": block.nis,
        "memory.accepted": block.accepted,
        "memory.rejected": block.visible & ~block.accepted,
    }
    scene, speed_mps = work.scene, np.linalg.norm(block.x[:, 3:6], axis=1)
    streets = scene.streets if scene.streets_known else None
    truth = np.column_stack([block.time_s, known, speed_mps])
    name = source.content["log"]
    shown = scenery(name, block.layout, scene.anchors_m, streets, len(axes), truth)
    weighed = isinstance(work.plan.modes, Bank)
    shown["contenders"]["track"] = course(told, work.plan.names, weighed)
    return Played(shown=[shown])


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.progress import say
    from experiments.webpage.page import page_of
    from mmwave_env.files import require_writable, write_text

    for name in ("episodes", "watch"):
        if getattr(args, name) < 0:
            raise ValueError(f"{name}: found {getattr(args, name)}, expected 0 or more")
    if args.out.suffix != ".html":
        raise ValueError(f"out: found {args.out}, expected a name that ends with .html")
    require_writable(args.out)
    page = page_of(args, localized)
    write_text(args.out, page)
    say(f"{args.out}, {len(page.encode()) / 1e3:.0f} kB: open it in a browser")
