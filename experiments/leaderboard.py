"""mmwave-loc leaderboard: the benchmark of docs/benchmark.md, from entries in a folder."""

import re

from experiments.arguments.leaderboard import Args
from experiments.cli.doc_pages import page_to_renew, renewed
from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.entries import by_venue, ranking, read_entry
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.protocol import RECORDED, entry, judge, require_contenders, venues
from experiments.evaluation.terminal import note
from mmwave_env.files import write_json, write_text


def _play(args: Args) -> None:
    """Judge the contenders, and keep their entries."""
    require_contenders(args.policies)
    judged = []
    for venue in venues():
        note(f"{venue.name} ({venue.kind})")
        count = args.draws if venue.kind == RECORDED else args.episodes
        judged.append(judge(args.policies, venue, count, args.seed))
    made = provenance("leaderboard", args)
    for name in args.policies:
        file = re.sub(r"[^\w.-]+", "-", name).strip("-")
        write_json(args.out / f"{file}.json", made | entry(name, judged))


def main(args: Args) -> None:
    """Run the command."""
    for name in ("episodes", "draws"):
        if getattr(args, name) < 2:
            raise ValueError(f"{name}: found {getattr(args, name)}, expected at least 2")
    page = page_to_renew(args.docs) if args.docs else ""
    if args.policies:
        _play(args)
    entries = [read_entry(path) for path in sorted(args.out.glob("*.json"))]
    if not entries:
        raise ValueError(f"out: found no entries in {args.out}; --policies makes some")
    ranked = ranking(entries, Args.episodes, Args.draws)
    tables = {"leaderboard": grid(*ranked), "venues": grid(*by_venue(entries))}
    show("\n\n".join(tables.values()))
    if args.docs:
        write_text(args.docs, renewed(page, tables))


if __name__ == "__main__":
    run("leaderboard")
