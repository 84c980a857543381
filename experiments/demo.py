"""mmwave-loc demo: comparisons of all policies, as in the tables of docs/results.md."""

from dataclasses import dataclass, replace
from pathlib import Path

from experiments.console.options import CompareArgs, PageArgs

RECORDINGS = "canyon28_pedestrian", "canyon28_vehicle"


@dataclass
class Args:
    """Compare all policies in simulations and on two ray-traced recordings.

    The files in the folder --out also contain all paired differences, which are
    not printed.

        mmwave-loc demo --episodes 100 --draws 20
    """

    episodes: int = 1000
    """number of simulated episodes"""
    draws: int = 200
    """number of episodes on each recording; every episode draws new receiver noise"""
    percentiles: bool = False
    """also write percentiles of errors, and protection levels, to the files"""
    out: Path = Path("results")
    """folder for tables.md, one JSON file per comparison, and report.html, a web page"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import note, say, show
    from experiments.console.provenance import provenance
    from experiments.reporting.comparison_results import results
    from experiments.reporting.webpage.page import page_of
    from mmwave_env.io.files import write_json, write_text

    counts = {None: args.episodes} | dict.fromkeys(RECORDINGS, args.draws)
    tables = []
    files = []
    for data, count in counts.items():
        options = CompareArgs(data=data, episodes=count, percentiles=args.percentiles)
        note(f"{data or 'mixed'}: {count} episodes with each policy")
        result, text, content, _ = results(options)
        show(str(replace(result, paired={})))
        tables.append(text)
        files.append(args.out / f"{result.scenario}.json")
        write_json(files[-1], provenance("compare", options) | content)
    write_text(args.out / "tables.md", "\n".join(tables))
    report = PageArgs(results=tuple(files), out=args.out / "report.html")
    note("web page: rerunning some episodes to show them epoch by epoch")
    write_text(report.out, page_of(report))
    say(
        f"All paired differences are in {args.out / 'tables.md'}, and all results in",
        f"{', '.join(map(str, files))}.",
        f"{report.out} is a web page of the results, with episodes to play: open it in a browser.",
        "README.md and docs/results.md say what the columns mean.",
        "next: mmwave-loc compare --policies ppo imm --radio standard",
    )
