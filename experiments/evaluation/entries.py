"""Entries of the benchmark as files, and the tables that rank them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.console.tables import Table
from experiments.evaluation.intervals import Interval
from experiments.evaluation.protocol import KINDS, RECORDED, TRAINED, standing, venues
from mmwave_env.io.files import read_json


def read_entry(path: Path) -> dict[str, Any]:
    """Read an entry that :func:`~experiments.evaluation.protocol.entry` made.

    Raises:
        ValueError: names the file and says what is wrong in it.
    """

    def checked(found: dict[str, Any]) -> dict[str, Any]:
        for key in ("entry", "venues", "mean_gain"):
            if key not in found:
                raise ValueError(f"{key}: found none, expected one beside {', '.join(found)}")
        require_entry(found)
        return found

    return read_json(path, "an entry", checked)


def require_entry(found: Mapping[str, Any]) -> None:
    """Refuse an entry that lacks what tables need.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: the entry is not complete.
    """
    missing = [venue.name for venue in venues() if venue.name not in found["venues"]]
    if missing:
        raise ValueError(f"venues: missing {', '.join(missing)}")
    ranking([found], 0, 0)
    by_venue([found])


def _episodes(one: Mapping[str, Any]) -> tuple[int, int]:
    """Return the fewest episodes in a simulated venue and on a recording."""
    simulated, recorded = (
        min(v["episodes"] for v in one["venues"].values() if (v["kind"] == RECORDED) == of_those)
        for of_those in (False, True)
    )
    return simulated, recorded


def ranking(entries: Sequence[Mapping[str, Any]], episodes: int, draws: int) -> Table:
    """Rank all entries by their mean gain in the venues to train in.

    Entries with too few episodes come last and are marked, as luck would decide their rank.

    Args:
        entries: entries in any order.
        episodes, draws: numbers that the protocol requires in a simulated venue and on a recording.
    """

    def short(one: Mapping[str, Any]) -> bool:
        simulated, recorded = _episodes(one)
        return simulated < episodes or recorded < draws

    rows: list[list[str | Interval]] = []
    for one in sorted(entries, key=lambda one: (short(one), -one["mean_gain"][TRAINED]["mean"])):
        simulated, recorded = _episodes(one)
        played = f"{simulated} / {recorded}{' (too few)' if short(one) else ''}"
        cells: list[str | Interval] = [one["entry"].removesuffix("/policy.safetensors"), played]
        for kind in KINDS:
            stands = [standing(v) for v in one["venues"].values() if v["kind"] == kind]
            counts = f"{stands.count('above')} / {stands.count('level')} / {stands.count('below')}"
            cells += [Interval.of(one["mean_gain"][kind]), counts]
        rows.append(cells)
    header = ["entry", "episodes / draws"]
    for kind in KINDS:
        header += [f"{kind}: minus imm-best", "above / level / below every IMM"]
    return Table(header, rows)


def by_venue(entries: Sequence[Mapping[str, Any]]) -> Table:
    """Return the reward of entries minus that of the best IMM of each venue.

    Files, such as the single trainings of a run, and the IMMs are left out where there are other
    entries; the ranking has them.
    """
    named = [one for one in entries if "/" not in one["entry"]]
    entries = [one for one in named if not one["entry"].startswith("imm")] or named or entries
    rows = []
    for venue in venues():
        cells = [venue.name]
        for one in entries:
            minus = one["venues"][venue.name]["minus"]
            best = min(minus, key=lambda imm: minus[imm]["mean"])
            cells.append(f"{Interval.of(minus[best])} ({best})")
        rows.append(cells)
    return Table(["venue", *(one["entry"] for one in entries)], rows)
