"""All sections of a page, and how what is in them was made."""

from collections.abc import Callable, Mapping, Sequence

from experiments.evaluation.entries import by_venue, ranking
from experiments.evaluation.protocol import DRAWS, EPISODES
from experiments.webpage.comparisons import add_comparisons
from experiments.webpage.kinds import (
    COMPARISON,
    DEFAULTS,
    ENTRY,
    EVOLUTION,
    GAINS,
    RUN,
    SWEEP,
    TRACK,
    TRANSFER,
    TRUST,
    Kind,
)
from experiments.webpage.learning import (
    add_defaults,
    add_evolution,
    add_gains,
    add_runs,
    add_sweeps,
    add_transfer,
    add_trust,
)
from experiments.webpage.logs import add_tracks
from experiments.webpage.markup import heading, paragraph, table, text
from experiments.webpage.played import Played
from experiments.webpage.sections import Page
from experiments.webpage.source import Source

Shown = Sequence[tuple[Source, Played]]  # results of one kind


def assembled(sources: Sequence[Source], played: Mapping[int, Played]) -> Page:
    """All sections that there is something for.

    Args:
        sources: results, in the order in which they are shown.
        played: what was played again, by the number of the source.
    """
    page = Page()
    for kind, add in _ADDERS:
        found = [
            (source, played.get(number, Played()))
            for number, source in enumerate(sources)
            if source.kind is kind
        ]
        if found:
            add(page, found)
    _add_origins(page, sources)
    return page


def _add_entries(page: Page, found: Shown) -> None:
    """The benchmark, from its entries."""
    entries = [source.content for source, _ in found]
    ranked = ranking(entries, EPISODES, DRAWS)
    best = "The reward minus that of the best IMM of each venue, whichever it is there"
    page.add(
        "Benchmark",
        table("Entries, by what they gain on the strongest IMM where one may train", *ranked),
        table(best, *by_venue(entries)),
    )


_ADDERS: tuple[tuple[Kind, Callable[[Page, Shown], None]], ...] = (  # in the order of sections
    (COMPARISON, add_comparisons),
    (TRACK, add_tracks),
    (ENTRY, _add_entries),
    (RUN, add_runs),
    (TRANSFER, add_transfer),
    (SWEEP, add_sweeps),
    (GAINS, add_gains),
    (TRUST, add_trust),
    (DEFAULTS, add_defaults),
    (EVOLUTION, add_evolution),
)


def _add_origins(page: Page, sources: Sequence[Source]) -> None:
    alike: dict[tuple[str, str, str], list[str]] = {}  # one command may write several files
    for source in sources:
        versions = ", ".join(f"{name} {number}" for name, number in source.versions.items())
        made = source.command, _seeds(source), versions
        alike.setdefault(made, []).append(source.path)
    for (command, seeds, versions), paths in alike.items():
        page.add(
            "How it was made",
            heading(paths[0] + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")),
            f"<pre><code>{text(command)}</code></pre>",
            paragraph(f"{seeds}Made with {versions or 'unknown versions'}."),
        )


def _seeds(source: Source) -> str:
    content = source.content
    if source.kind is COMPARISON and "seed" in content:
        last = content["seed"] + content["episodes"] - 1
        return f"Seeds {content['seed']} to {last}. "
    if "keys" in content:
        return f"Keys {', '.join(map(str, content['keys']))}. "
    if source.kind is RUN:
        seeds = ", ".join(name.removeprefix("seed-") for name in content["curves"])
        return f"Training seeds {seeds or 'none yet'}. "
    return f"Seed {content['seed']} and up. " if "seed" in content else ""
