"""Sections of comparisons: results, errors, episodes."""

from collections.abc import Mapping, Sequence
from typing import Any

from experiments.console.tables import HEADERS
from experiments.evaluation.bounds import COLUMNS
from experiments.webpage import charts
from experiments.webpage.kinds import selected
from experiments.webpage.markup import heading, paragraph, short, table, whole
from experiments.webpage.played import Played, watched_names
from experiments.webpage.positions import position_table, stanford
from experiments.webpage.sections import Page
from experiments.webpage.shown_episodes import add_episodes, left_out
from experiments.webpage.source import Source
from mmwave_env.metrics import METRICS


def add_comparisons(page: Page, found: Sequence[tuple[Source, Played]]) -> None:
    """All there is about comparisons."""
    for source, played in found:
        _add_comparison(page, source)
        _add_errors(page, source, played)
    for source, played in found:
        names = watched_names(source.content["policies"])
        add_episodes(page, f"{source.content['scenario']}: ", played, names)


def _title(source: Source) -> str:
    """Of a comparison: what was played."""
    content = source.content
    return f"{content['scenario']}, {content['radio']}, {selected(content)}"


def _add_comparison(page: Page, source: Source) -> None:
    content, policies = source.content, source.content["policies"]
    ranked = sorted(policies, key=lambda name: -policies[name]["reward"]["mean"])
    columns = [metric for metric in METRICS if all(metric in row for row in policies.values())]
    rows = [[name, *(short(policies[name][metric]) for metric in columns)] for name in ranked]
    page.add(
        "Results",
        heading(_title(source)),
        page.drawn(charts.whiskers(source)),
        table(
            "Means, ± half the 95 % interval over episodes; best reward first",
            ["policy", *(HEADERS[metric] for metric in columns)],
            rows,
        ),
    )
    differences = charts.paired(content)
    if differences:
        header = ["reward of", *(f"minus {reference}" for reference in differences)]
        rows = [
            [
                name,
                *(whole(pairs.get(name, {}).get("reward")) for pairs in differences.values()),
            ]
            for name in ranked
        ]
        caption = "Paired differences of the reward, episode by episode, with 95 % intervals"
        page.add("Results", table(caption, header, rows))
    if "position_errors" in content:
        errors = content["position_errors"]
        page.add("Results", position_table("policy", errors["policies"], errors["risk"]))
    if "bound" in content:
        _add_bound(page, content["bound"])
    if "training_seeds" in content:
        _add_training_seeds(page, content["training_seeds"])
    if "decisions" in content:
        page.add("Results", page.drawn(charts.around_events(content["decisions"])))


def _add_bound(page: Page, bound: Mapping[str, Any]) -> None:
    policies = bound["policies"]
    rows = [[name, *(whole(row[column]) for column in COLUMNS)] for name, row in policies.items()]
    caption = "RMSE, and over the posterior Cramér-Rao bounds"
    page.add("Results", table(caption, ["policy", *COLUMNS.values()], rows))


def _add_training_seeds(page: Page, trained: Mapping[str, Any]) -> None:
    for name, run in trained.items():
        figures = {"reward": run["reward"], **{f"minus {r}": f for r, f in run["minus"].items()}}
        rows = []
        for seed in run["reward"]["seeds"]:
            mark = f"{seed} (median)" if seed == str(run["median"]) else seed
            rows.append([mark, *(whole(figure["seeds"][seed]) for figure in figures.values())])
        for what, key in (("mean", "mean"), ("interquartile mean", "interquartile_mean")):
            rows.append([what, *(whole(figure[key]) for figure in figures.values())])
        page.add("Results", table(f"Over training seeds, {name}", ["seed", *figures], rows))
    if any(run["minus"] for run in trained.values()):
        page.add("Results", page.drawn(charts.profiles(trained)))


def _add_errors(page: Page, source: Source, played: Played) -> None:
    parts = [heading(_title(source)), *left_out(played)]
    if played.errors_m:
        parts.append(
            paragraph(
                f"Epoch by epoch, of {played.which}, played again for this page; the first "
                "10 epochs of an episode are left out."
            )
        )
        figures = {name: one.figures() for name, one in played.positions.items()}
        (risk,) = {one.risk for one in played.positions.values()}
        parts += [
            page.drawn(charts.error_curves(played)),
            position_table("policy", figures, risk),
            page.drawn(stanford(played.positions)),
        ]
        parts.append(page.drawn(charts.nees_curves(played)))
    page.add("Errors", *parts)
