"""mmwave-loc leaderboard: the benchmark of docs/benchmark.md, and the ranking of its entries."""

import re
from dataclasses import dataclass
from pathlib import Path

from experiments.console.options import require_at_least


@dataclass(kw_only=True)
class Args:
    """Judge policies and IMMs by the benchmark's protocol; rank all entries.

    A site is a street or a recording, with a radio. Contenders are not trained
    here. They run, together with the paper's rule and every IMM, at four kinds
    of sites: the nine sites where policies may be trained, unseen sites,
    recordings, and hard sites (unusual motion or receivers). A contender's
    entry (its results at all sites) is written to a JSON file in the folder
    --out. The tables show all entries in this folder, and four shipped entries,
    ranked by their gains over imm-best at the sites to train in; the last table
    has the scores. One of the entries is for the clairvoyant, a policy that
    knows the truth; its score is 100 by definition.

        mmwave-loc leaderboard --policies imm-best --episodes 400 --draws 20
    """

    policies: tuple[str, ...] = ()
    """contenders, as in mmwave-loc compare; if none is named,
    only existing entries are shown"""
    episodes: int = 2000
    """number of episodes on each simulated street"""
    draws: int = 200
    """number of draws of receiver noise on each recording"""
    seed: int = 0
    """seed of the first episode; test seeds, for reported results, start at 0"""
    out: Path = Path("results/leaderboard")
    """folder of entries, one JSON file each"""
    keep: bool = False
    """skip the policies that already have an entry in the
    folder; judge the others one by one, and write each
    entry when it is ready, so that the same command
    continues after an interruption"""
    verify: tuple[Path, ...] = ()
    """entries (JSON files) to verify: their policies play
    again at two sites, the claimed episodes and 50 of
    seeds drawn at random, and must reach their figures"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import note, say, show
    from experiments.console.provenance import provenance
    from experiments.evaluation import protocol
    from experiments.evaluation.contenders import contender_from
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
        groups = [(name,) for name, file in files.items() if not file.exists()]
    for names in groups:
        judged = []
        for site in protocol.sites():
            note(f"{', '.join(names)}: {site.name} ({site.kind})")
            count = args.draws if site.kind == protocol.RECORDED else args.episodes
            judged.append(protocol.judge(names, site, count, args.seed))
        for name in names:
            entry = provenance("leaderboard", args) | protocol.entry(name, judged)
            write_json(files[name], protocol.sealed(entry))
    if not any(args.out.glob("*.json")):
        raise ValueError(f"out: found no entries in {args.out}; name contenders with --policies")
    entries = protocol.entries_in(args.out)
    show(protocol.tables_of(entries, protocol.ceiling_of(entries)))
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
