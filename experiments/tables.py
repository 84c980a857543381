"""mmwave-loc tables: the paper's tables and claims, compared with measurements in simulations."""

from dataclasses import dataclass
from pathlib import Path


@dataclass
class Args:
    """Reproduce Tables I, II and III of the paper and test its claims.

    mmwave-loc tables --episodes 100
    """

    episodes: int = 1000
    """number of simulated episodes for each kind of user and radio"""
    seed: int = 0
    """seed of the first episode; 0 is the first seed for results that are published"""
    out: Path = Path("results/paper")
    """folder for tables.md and tables.csv"""


SECTIONS = 18  # number of sections, for the progress bar
FIELDS = ("section", "row", "column", "mean", "low", "high")


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import csv_text, say, show, tracked
    from experiments.paper.claims import sections
    from experiments.paper.printed import Bench, summaries
    from mmwave_env.io.files import require_writable, write_text

    require_writable(args.out / "tables.md")
    bench = Bench(args.episodes, args.seed)
    results = {section.title: section for section in tracked(sections(bench), "tables", SECTIONS)}
    text = "\n".join([summaries(results), *(section.markdown() for section in results.values())])
    records = [record for section in results.values() for record in section.records()]
    write_text(args.out / "tables.md", text)
    write_text(args.out / "tables.csv", csv_text([FIELDS, *records]))
    show(text)
    say(f"written to {args.out}/")
