"""mmwave-loc tables: the paper's tables and claims beside what this model measures."""

import csv
import io
from collections.abc import Iterator

from experiments.arguments.tables import Args
from experiments.cli.doc_pages import page_to_renew, renewed
from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.markdown import show
from experiments.evaluation.terminal import say, tracked
from experiments.figures.canvas import require_picture
from experiments.paper.accuracy import error_budget, headline
from experiments.paper.bench import Bench, Section
from experiments.paper.claims import CLAIMS
from experiments.paper.figure import draw
from experiments.paper.printed import table_three, tables_one_and_two
from mmwave_env.files import require_writable, write_json, write_text

SECTIONS = 19
FIELDS = ("section", "row", "column", "mean", "low", "high")


def sections(bench: Bench) -> Iterator[Section]:
    """Everything there is, in order."""
    yield from tables_one_and_two(bench)
    yield table_three(bench)
    yield from (claim(bench) for claim in CLAIMS)
    yield headline(bench)
    yield error_budget(bench)


def main(args: Args) -> None:
    """Run the command."""
    if args.episodes < 1:
        raise ValueError(f"episodes: found {args.episodes}, expected at least 1")
    figures = [args.out / "tables.png"] + ([args.docs.with_suffix(".png")] if args.docs else [])
    for figure in figures:
        require_picture("out", figure)
    require_writable(args.out / "tables.md")
    page = page_to_renew(args.docs) if args.docs else ""
    bench = Bench(args.episodes, args.seed)
    found = {}
    for section in tracked(sections(bench), "tables", SECTIONS):
        found[section.title] = section
    text = "\n".join(section.markdown() for section in found.values())
    records = [record for section in found.values() for record in section.records()]
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows([FIELDS, *records])
    write_text(args.out / "tables.md", text)
    write_text(args.out / "tables.csv", table.getvalue())
    if args.json:
        rows = [dict(zip(FIELDS, record, strict=True)) for record in records]
        content = {"episodes": args.episodes, "seed": args.seed, "figures": rows}
        write_json(args.json, provenance("tables", args) | content)
    if args.docs:
        bodies = {title: section.body() for title, section in found.items()}
        write_text(args.docs, renewed(page, bodies))
    try:
        for figure in figures:
            draw(found, figure)
    finally:  # a picture that fails costs nobody the tables
        show(text)
    say(f"written to {args.out}/")


if __name__ == "__main__":
    run("tables")
