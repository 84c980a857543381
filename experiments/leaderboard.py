"""mmwave-loc leaderboard: the benchmark of docs/benchmark.md, from entries in a folder."""

import json
import re
import sys
from pathlib import Path
from typing import Any

from experiments.arguments.leaderboard import Args
from experiments.cli.doc_pages import page_to_renew, renewed
from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.intervals import Interval
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.protocol import (
    KINDS,
    RECORDED,
    TRAINED,
    entry,
    judge,
    require_contenders,
    standing,
    venues,
)
from mmwave_env.files import write_json, write_text


def read_entry(path: Path) -> dict[str, Any]:
    """An entry as :func:`~experiments.evaluation.protocol.entry` made it.

    Raises:
        ValueError: naming the file and what is wrong in it.
    """
    try:
        found: Any = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected an object")
        for key in ("entry", "venues", "mean_gain"):
            if key not in found:
                raise ValueError(f"{key}: found none, expected one beside {', '.join(found)}")
        missing = [venue.name for venue in venues() if venue.name not in found["venues"]]
        if missing:
            raise ValueError(f"venues: missing {', '.join(missing)}")
        ranking([found])
        by_venue([found])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: not an entry: {error}") from error
    return found


def _interval(figures: dict[str, Any]) -> Interval:
    low, high = figures["ci95"] or (float("nan"), float("nan"))
    return Interval(figures["mean"], low, high)


def _episodes(one: dict[str, Any]) -> tuple[int, int]:
    """The fewest in a simulated venue and on a recording."""
    simulated, recorded = (
        min(v["episodes"] for v in one["venues"].values() if (v["kind"] == RECORDED) == of_those)
        for of_those in (False, True)
    )
    return simulated, recorded


def _short(one: dict[str, Any]) -> bool:
    """Whether it has fewer episodes than the protocol asks for, which the command plays."""
    simulated, recorded = _episodes(one)
    return simulated < Args.episodes or recorded < Args.draws


def ranking(entries: list[dict[str, Any]]) -> str:
    """All entries, best first by their mean gain in the places to train in.

    Those of too few episodes come last, and are marked: luck would rank them.
    """
    rows = []
    for one in sorted(entries, key=lambda one: (_short(one), -one["mean_gain"][TRAINED]["mean"])):
        simulated, recorded = _episodes(one)
        episodes = f"{simulated} / {recorded}{' (too few)' if _short(one) else ''}"
        cells = [one["entry"].removesuffix("/policy.safetensors"), episodes]
        for kind in KINDS:
            stands = [standing(v) for v in one["venues"].values() if v["kind"] == kind]
            counts = f"{stands.count('above')} / {stands.count('level')} / {stands.count('below')}"
            cells += [str(_interval(one["mean_gain"][kind])), counts]
        rows.append(cells)
    header = ["entry", "episodes / draws"]
    for kind in KINDS:
        header += [f"{kind}: minus imm-best", "above / level / below every IMM"]
    return grid(header, rows)


def by_venue(entries: list[dict[str, Any]]) -> str:
    """The reward of entries minus that of the best IMM of each venue, whichever it is there.

    Files, such as the single trainings of a run, have their row in the ranking alone, where there
    are entries that have a name.
    """
    entries = [one for one in entries if "/" not in one["entry"]] or entries
    rows = []
    for venue in venues():
        cells = [venue.name]
        for one in entries:
            minus = one["venues"][venue.name]["minus"]
            best = min(minus, key=lambda imm: minus[imm]["mean"])
            cells.append(f"{_interval(minus[best])} ({best})")
        rows.append(cells)
    return grid(["venue", *(one["entry"] for one in entries)], rows)


def _play(args: Args) -> None:
    """Judge the contenders, and keep their entries."""
    require_contenders(args.policies)
    judged = []
    for venue in venues():
        print(f"{venue.name} ({venue.kind})", file=sys.stderr, flush=True)
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
    tables = {"leaderboard": ranking(entries), "venues": by_venue(entries)}
    show("\n\n".join(tables.values()))
    if args.docs:
        write_text(args.docs, renewed(page, tables))


if __name__ == "__main__":
    run("leaderboard")
