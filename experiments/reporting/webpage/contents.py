"""Contents of the web page: verdicts, tables and pictures of results."""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

from experiments.evaluation.comparison import Comparison
from experiments.evaluation.contenders import DESCRIPTIONS
from experiments.evaluation.positions import positions_markdown
from experiments.evaluation.runs import outcomes_markdown
from experiments.evaluation.seeds import named
from experiments.reporting.figures.canvas import PHONE_MM
from experiments.reporting.figures.curves import (
    draw_consistency,
    draw_error_cdf,
    draw_learning_curves,
)
from experiments.reporting.track_report import track_markdown
from experiments.reporting.webpage.markup import drawn, element, html_of, table
from experiments.reporting.webpage.played import Played, watched_names
from experiments.reporting.webpage.sources import Source
from mmwave_env.io.files import Json

WORDS = (
    "reward: per epoch, minus the position error in m, and minus a penalty if the filter misjudges "
    "its error. ATE: mean position error. RMSE: root of the mean square error. RPE: change of the "
    "error within a second. NEES: squared error relative to the filter's own covariance; 3 is "
    "right (2 on flat ground), more is too confident. diverged: share of episodes whose error "
    "exceeds 50 m at some time. Wide tables scroll sideways."
)


class Verdict(NamedTuple):
    """A name for results, and their outcome as a title and as a sentence."""

    name: str
    title: str
    sentence: str


def results_of(source: Source) -> tuple[Verdict, str]:
    """Return the verdict on the results of a source, and HTML of its tables and pictures.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the content is not complete.
    """
    content = source.content
    if source.kind == "track":
        return _track_verdict(content), html_of(track_markdown(dict(content)))
    if source.kind == "run":
        over = len(content["seeds"])
        begun = len(content["curves"])
        title = f"{over} of {begun} training seeds of {source.path} are finished"
        more = "" if over == begun else "; mmwave-loc train --resume continues the other seeds"
        return Verdict(source.path, title, f"{title}{more}."), "".join(_trainings(source))
    comparison = Comparison.from_json(content)
    return _verdict(comparison), "".join(_compared(comparison))


def _verdict(comparison: Comparison) -> Verdict:
    """Return the verdict on the best contender and the next contender that is paired with it."""
    best, *others = comparison.policies
    name = f"{comparison.scenario}, {comparison.radio}, {named(comparison.seeds)}"
    about = f"{len(others) + 1} policies on {name}." if others else f"{best} on {name}."
    paired = ((other, comparison.margin(best, other)) for other in others)
    other, by = next(((other, margin) for other, margin in paired if margin), ("", None))
    if by is None:
        reward = comparison.policies[best]["reward"]
        return Verdict(name, f"{best} has a reward of {reward}", f"{about} Best reward: {reward}.")
    interval = ", a 95 % interval over episodes" if by.known else ""
    title = f"{best} beats {other} by {by}"
    if by.low <= 0.0:
        title = f"{best} and {other} are level"
        about += f" No winner: the reward of {best} minus the reward of {other} is {by}{interval}."
    else:
        about += f" {best} won: its reward per epoch is {by} above the reward of {other}{interval}."
    if unpaired := others[: others.index(other)]:
        about += f" Ranked between these two, but not paired with {best}: {', '.join(unpaired)}."
    return Verdict(name, title, about)


def _track_verdict(c: Json) -> Verdict:
    title = f"{c['epochs']} epochs of {c['log']}, {c['first_s']:.13g} to {c['last_s']:.13g} s"
    tracks = c["truth"]["tracks"] if "truth" in c else {}
    ates = [f"the {name} track has an ATE of {row['ate_m']:.3f} m" for name, row in tracks.items()]
    broken = [f"only part of the log was used: {c['error']}"] if c.get("error") else []
    return Verdict(f"{c['log']}, {c['scene']}", title, f"{'; '.join([title, *ates, *broken])}.")


def _compared(comparison: Comparison) -> Iterator[str]:
    header, rows = comparison.table()
    yield table("Means ± half the widths of 95 % intervals, best reward first", header, rows)
    pairs = [
        [name, other, pair["reward"], pair["ate_m"]]
        for name in comparison.policies
        for other in comparison.policies
        if (pair := comparison.paired.get(f"{name} - {other}"))
    ]
    caption = "Differences, paired by episode, with 95 % intervals"
    yield table(caption, ["policy", "minus", "reward", "ATE m"], pairs) if pairs else ""
    for name in comparison.policies:
        if name in DESCRIPTIONS:
            yield element("p", f"{name}: {DESCRIPTIONS[name]}", "caption")
    yield element("p", WORDS, "caption")


def _trainings(source: Source) -> Iterator[str]:
    seeds = source.content["seeds"]
    curves = source.content["curves"].values()
    if seeds:
        yield element("p", "The best policy of each training seed, on tuning seeds", "caption")
        yield html_of(outcomes_markdown(seeds))
    rivals = dict.fromkeys(rival for curve in curves for rival in curve)
    for rival in rivals:
        lines = [curve[rival] for curve in curves if rival in curve]
        draw = partial(draw_learning_curves, f"reward minus reward of {rival}", lines)
        yield drawn(f"Gain in reward over {rival} on tuning seeds, a line per training seed", draw)


def errors_of(source: Source, played: Played) -> Iterator[str]:
    """Yield HTML tables and pictures of the errors of a comparison; nothing for other sources."""
    if source.kind != "comparison":
        return
    ranked = [*Comparison.from_json(source.content).policies]
    if figures := source.content.get("position_errors"):  # from --percentiles
        policies = figures["policies"]
        rows = {name: policies[name] for name in ranked if name in policies}
        about = "Errors in all episodes, without the first 10 epochs of each"
        yield element("p", about, "caption")
        kind = figures.get("levels", "gaussian")
        yield html_of(positions_markdown("policy", rows, figures["risk"], kind))
    errors_m = played.epochs.errors_m
    nees = played.epochs.nees
    if shown := [name for name in watched_names(ranked) if name in errors_m]:
        draw = partial(draw_error_cdf, {name: errors_m[name] for name in shown}, width_mm=PHONE_MM)
        yield drawn(f"Distribution of errors (CDF), {played.which}", draw)
        chosen = {name: nees[name] for name in shown}
        draw = partial(
            draw_consistency, played.epochs.time_s, chosen, played.axes, width_mm=PHONE_MM
        )
        yield drawn(f"NEES and its chi-square bounds, {played.which}", draw)


def origin_of(title: str, command: str, versions: Json) -> str:
    """Return HTML with the command and the package versions that made results or this page."""
    made = ", ".join(f"{name} {version}" for name, version in versions.items())
    parts = element("h3", title), element("pre", command)
    return "".join(parts) + (element("p", f"Made with {made}.") if versions else "")
