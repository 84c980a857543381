"""mmwave-loc report: one self-contained web page of results."""

from experiments.console.options import PageArgs as Args
from experiments.console.options import require_at_least


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import say
    from experiments.reporting.webpage.page import page_of
    from mmwave_env.io.files import require_writable, write_text

    if not args.results:
        raise ValueError("results: found none, expected at least one file")
    require_at_least(0, args, "episodes")
    if args.out.suffix != ".html":
        raise ValueError(f"out: found {args.out}, expected a name that ends with .html")
    require_writable(args.out)
    page = page_of(args)
    write_text(args.out, page)
    say(f"{args.out}, {len(page.encode()) / 1e3:.0f} kB: open it in a browser")
