"""mmwave-loc report: one self-contained web page of results."""

from dataclasses import dataclass

from experiments.console.options import PageArgs, require_at_least


@dataclass(kw_only=True)
class Args(PageArgs):
    """Make one web page of results, which a browser shows offline.

    The page says which policy won by how much, and has tables, distributions of
    errors (CDF) and episodes to play. Results are JSON files (--json) of the
    commands compare, demo and localize, and folders of runs of train. Results
    do not store single epochs, so the command runs episodes again, with the
    stored options. Agents in your own code (module:function) are not run again:
    the page lacks their episodes, and shows their errors only if the files
    store them.

        mmwave-loc report results.json runs/train --out report.html
    """


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.progress import say
    from experiments.reporting.webpage.page import page_of
    from mmwave_env.io.files import require_writable, write_text

    if not args.results:
        raise ValueError("results: found none, expected at least one file or folder")
    require_at_least(0, args, "episodes", "watch")
    if args.out.suffix != ".html":
        raise ValueError(f"out: found {args.out}, expected a name that ends with .html")
    require_writable(args.out)
    page = page_of(args)
    write_text(args.out, page)
    say(f"{args.out}, {len(page.encode()) / 1e3:.0f} kB: open it in a browser")
