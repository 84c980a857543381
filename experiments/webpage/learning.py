"""Sections of trainings, and of what they are worth on test seeds: transfer, ablations, studies."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.console.tables import HEADERS
from experiments.webpage import charts
from experiments.webpage.kinds import gains_of
from experiments.webpage.markup import Cell, Written, folded, paragraph, short, table, whole
from experiments.webpage.played import Played
from experiments.webpage.sections import Page
from experiments.webpage.source import Source

STUDIES = "Studies"  # title of the section


def add_runs(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """What trainings came to on tuning seeds."""
    runs = [source for source, _ in found]
    for run in runs:
        if not run.content["over"]:
            done, begun = len(run.content["seeds"]), len(run.content["curves"])
            page.add("Learning", paragraph(
                f"{run.path}: interrupted, or still under way: {done} of {begun} trainings begun "
                "are over. What is there is shown; mmwave-loc train --resume goes on.", "warning",
            ))  # fmt: skip
    curves = charts.learning_curves(runs)
    if curves:
        page.add("Learning", page.drawn(curves))
    folders: dict[str, list[Source]] = {}
    for run in runs:
        folders.setdefault(str(Path(run.path).parent), []).append(run)
    for folder, together in folders.items():
        if len(together) > 1:
            _add_ablation(page, folder, together)
            page.add("Learning", folded(f"{folder}: every training", map(_seeds, together)))
        else:
            page.add("Learning", _seeds(together[0]))


def _seeds(run: Source) -> str:
    """The trainings of a run that are over."""
    seeds = run.content["seeds"]
    if not seeds:
        return ""
    gains = list(dict.fromkeys(k for one in seeds for k in one["best"] if k.startswith("minus ")))
    rows: list[list[str | Cell]] = []
    for one in seeds:
        best, beat = one["best"], one.get("beat_rule")
        mark = " (median)" if one["seed"] == run.content.get("median") else ""
        rows.append([
            f"{one['seed']}{mark}", Cell(f"{best['reward']:.4f}", best["reward"]),
            Cell(f"{best['timesteps']:,}", best["timesteps"]),
            *(whole(best.get(gain)) for gain in gains),
            f"{beat['timesteps']:,} steps, {beat['seconds']:g} s" if beat else "never",
        ])  # fmt: skip
    header = ["training seed", "reward", "best after steps", *gains, "beat the rule after"]
    return table(f"{run.path}, on tuning seeds", header, rows)


def _add_ablation(page: Page, folder: str, runs: Sequence[Source]) -> None:
    """Runs beside each other: what a change of the training came to."""
    done = [run for run in runs if run.content["seeds"]]
    medians = {run.path: _median(run.content["seeds"]) for run in done}
    gains = list(dict.fromkeys(g for one in medians.values() for g in one if g.startswith("minus")))
    gains = [gain for gain in gains if ":" not in gain]  # of single places
    rows: list[list[str | Cell]] = [
        [
            Path(run.path).name,
            str(len(run.content["seeds"])),
            Cell(f"{best['reward']:.4f}", best["reward"]),
            *(whole(best.get(gain)) for gain in gains),
        ]
        for run, best in zip(done, medians.values(), strict=True)
    ]
    header = ["run", "seeds", "reward", *gains]
    caption = f"{folder}: runs beside each other, the median training of each, on tuning seeds"
    page.add("Learning", table(caption, header, rows))


def _median(seeds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The best policy of the median training, as train picks it."""
    ranked = sorted(seeds, key=lambda one: -one["best"]["reward"])
    best: dict[str, Any] = ranked[len(ranked) // 2]["best"]
    return best


def add_transfer(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """Policies where they were trained and elsewhere."""
    for source, _ in found:
        _add_transfer(page, source)


def _add_transfer(page: Page, source: Source) -> None:
    places = source.content["places"]
    columns = list(dict.fromkeys(column for row in places.values() for column in row))
    rows = [[place, *(whole(row.get(c)) for c in columns)] for place, row in places.items()]
    caption = f"Reward where it was trained ({source.content['radio']}) and elsewhere"
    page.add("Transfer", table(caption, ["street or recording, radio", *columns], rows))


# --- studies, on test seeds


def add_gains(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """Tables of learned that hold intervals: ablations and studies."""
    for source, _ in found:
        title, gains = source.content["title"], source.content["gains"]
        columns = list(dict.fromkeys(column for row in gains.values() for column in row))
        rows = [[name, *(whole(row.get(c)) for c in columns)] for name, row in gains.items()]
        page.add(STUDIES, table(f"{title}: reward on test seeds", ["", *columns], rows))


def add_sweeps(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """What every combination of a sweep came to, and what failed."""
    for source, _ in found:
        rows, failed = source.content["sweep"], source.content["failed"]
        columns = [one for one in HEADERS if any(one in row for row in rows.values())]
        header = ["cells", *(HEADERS[one] for one in columns)]
        body = [[name, *(short(row[one]) for one in columns)] for name, row in rows.items()]
        page.add("Sweeps", table(f"{source.path}: {source.content['cells']} cells", header, body))
        if failed:
            told = (f"{one['cell']}: {one['error']}" for one in failed)
            page.add("Sweeps", paragraph(f"{len(failed)} cells failed.", "warning"))
            page.add("Sweeps", folded("Cells that failed", map(paragraph, told)))


def add_trust(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """Whom a policy trusts around events."""
    for source, _ in found:
        page.add(
            STUDIES, page.drawn(charts.trust(source.content["title"], source.content["trust"]))
        )


def add_defaults(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """Agents of other libraries with all their defaults."""
    for source, _ in found:
        c = source.content
        gains = list(dict.fromkeys(gain for row in c["rows"] for gain in gains_of(row)))
        rows: list[list[Written]] = []
        for row in c["rows"]:
            mean = sum(row["each"]) / len(row["each"])
            rows.append([
                row["library"], row["beliefs"], f"{row['seconds']} s", Cell(f"{mean:.3f}", mean),
                *(whole(row.get(gain)) for gain in gains),
            ])  # fmt: skip
        header = ["PPO of", "beliefs", "core time", "reward, mean of trainings", *gains]
        caption = (
            f"Other libraries with all their defaults: {c['seeds']} trainings of {c['steps']:,} "
            f"steps each, on {c['episodes']} test episodes"
        )
        page.add(STUDIES, table(caption, header, rows))


def add_evolution(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """Trust that an evolution strategy found."""
    for source, _ in found:
        c, tuning = source.content, source.content["tuning"]
        gains = gains_of(tuning)
        header = ["agent", "generations", "points of each", "episodes of each point", "core time"]
        row: list[Written] = ["linear in features"]
        row += [str(c[key]) for key in ("generations", "population", "episodes")]
        row += [f"{c['seconds']} s", *(whole(tuning[gain]) for gain in gains)]
        caption = (
            "Trust in modes by an evolution strategy: what it came to on tuning seeds "
            f"({tuning['episodes']} from {tuning['seed']:,} on)"
        )
        page.add(STUDIES, table(caption, [*header, *gains], [row]))
