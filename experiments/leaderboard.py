"""mmwave-loc leaderboard: the benchmark of docs/benchmark.md, and the ranking of its entries."""

import re
from pathlib import Path

from experiments.console.options import LeaderboardArgs as Args
from experiments.console.options import require_at_least


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import note, say, show
    from experiments.console.provenance import provenance
    from experiments.evaluation import protocol
    from experiments.evaluation.contenders import contender_from, fingerprint
    from mmwave_env.io.files import write_json

    if args.verify:
        verify_entries(args.verify)
        return
    require_at_least(2, args, "episodes", "draws")
    if args.out.is_file():
        raise ValueError(f"out: found the file {args.out}, expected a folder")
    for name in args.policies:
        contender_from(name, "handset")  # refuses an unknown name
    protocol.entries_in(args.out)  # refuses a damaged entry
    groups = [args.policies] if args.policies else []
    files = {
        name: args.out / (re.sub(r"[^\w.-]+", "-", name).strip("-") + ".json")
        for name in args.policies
    }
    if args.keep:
        groups = [
            (name,)
            for name, file in files.items()
            if not file.exists() or protocol.read_entry(file)["policy"] != fingerprint(name)
        ]
    for names in groups:
        judged = {}
        for site in protocol.sites():
            note(f"{', '.join(names)}: {site.name} ({site.kind})")
            count = args.draws if site.kind == protocol.RECORDED else args.episodes
            judged[site] = protocol.judge(names, site, count, args.seed)
        for name in names:
            entry = provenance("leaderboard", args) | protocol.entry(name, judged)
            write_json(files[name], protocol.sealed(entry))
    show(protocol.tables_of(protocol.entries_in(args.out)))
    if files:
        say(f"entries in {', '.join(map(str, files.values()))}")


def verify_entries(files: tuple[Path, ...]) -> None:
    """Verify entries, one by one, and print what differs.

    Raises:
        ValueError: an entry was changed, or its policy does not reach its figures.
    """
    from experiments.console.output import say
    from experiments.evaluation.protocol import verify
    from mmwave_env.io.files import UNEXPECTED, first_line

    refused = []
    for file in files:
        try:
            differences = verify(file)
        except (*UNEXPECTED, OSError) as error:
            differences = [first_line(error)]
        if differences:
            refused.append(str(file))
        outcome = "refused" if differences else "verified, played again at two sites"
        say(f"{file}: {outcome}", *differences)
    if refused:
        raise ValueError(f"verify: found {len(refused)} of {len(files)} entries that do not hold")
