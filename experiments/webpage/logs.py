"""The section of logs that were localized."""

from collections.abc import Sequence

from experiments.console.tables import HEADERS
from experiments.evaluation.positions import kinds_of
from experiments.webpage.markup import Cell, heading, paragraph, table
from experiments.webpage.played import Played
from experiments.webpage.positions import position_table
from experiments.webpage.sections import Page
from experiments.webpage.shown_episodes import add_episodes, left_out
from experiments.webpage.source import Source


def add_tracks(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """All there is about logs."""
    for source, played in found:
        _add_track(page, source, played)


def _add_track(page: Page, source: Source, played: Played) -> None:
    c = source.content
    parts = [heading(f"{c['log']}, scene {c['scene']}, {c['radio']}")]
    if c.get("error"):
        parts.append(paragraph(f"Not the whole log: {c['error']}", "warning"))
    seconds = f"{c['first_s']:.10g} to {c['last_s']:.10g} s"
    shares = [[name, str(count), f"{100.0 * count / max(1, c['epochs']):.1f} %"]
              for name, count in c["modes"].items()]  # fmt: skip
    parts += [
        paragraph(f"{c['epochs']} epochs, {seconds}; modes {c.get('rule', '')}"),
        table("Modes that ran", ["mode", "epochs", "share"], shares),
    ]
    if "truth" in c:
        metrics = ["ate_m", "rmse_m", "rpe_m", "nees", "in_bounds"]
        rows = [[name, *(_number(row.get(m)) for m in metrics)]
                for name, row in c["truth"]["tracks"].items()]  # fmt: skip
        header = ["track", *(HEADERS[metric] for metric in metrics)]
        parts.append(table("Against the truth", header, rows))
        errors = {name: kinds_of(row) for name, row in c["truth"]["tracks"].items()}
        if "risk" in c["truth"]:  # older results have no such figures
            parts.append(position_table("track", errors, c["truth"]["risk"]))
    names = {"seen": "seen", "rejected": "rejected", "incomplete": "incomplete",
             "nis_per_dof": "NIS / dof", "nis_in_bounds": "NIS in 95 % bounds"}  # fmt: skip
    rows = [[name, *(_number(group.get(key)) for key in names)]
            for name, group in c["groups"].items()]  # fmt: skip
    parts.append(table("Measurements and their gates", ["measured", *names.values()], rows))
    page.add("Tracks", *parts, *left_out(played))
    add_episodes(page, "", played, ["track"])


def _number(value: float | None) -> Cell:
    if value is None:
        return Cell("-")
    return Cell(str(value) if isinstance(value, int) else f"{value:.3f}", value)
