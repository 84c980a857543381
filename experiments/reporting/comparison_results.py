"""Runs of contenders and the tables that ``compare`` and ``demo`` print of them."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from experiments.console.options import EpisodeArgs
from experiments.console.progress import progress
from experiments.console.provenance import provenance
from experiments.console.tables import show
from experiments.evaluation.asked import (
    all_contenders,
    contender_of,
    runs_of,
    selection_of,
    task_of,
)
from experiments.evaluation.bounds import bound_markdown, over_bound
from experiments.evaluation.comparison import Comparison, compare_scores, episodes_csv
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.runs import trainings
from experiments.evaluation.training_seeds import over_training_seeds, seeds_markdown
from experiments.reporting.watchers import require_options, watchers
from mmwave_env.interface.reward import reward_name
from mmwave_env.io.files import write_json, write_text
from mmwave_env.models.radio import radio_from


class Results(NamedTuple):
    """Results of a comparison: tables, figures, and pictures to draw."""

    comparison: Comparison
    text: str  # all tables as Markdown
    json: dict[str, Any]  # every figure
    pictures: Sequence[Callable[[], None]]  # each writes a picture

    def draw(self) -> None:
        """Write the pictures."""
        for picture in self.pictures:
            picture()


def report(command: str, args: EpisodeArgs, found: Results) -> None:
    """Write ``args.json``, then the pictures, and print the tables of :func:`results`."""
    if args.json:  # first, because whoever reads the tables may close the pipe
        write_json(args.json, provenance(command, args) | found.json)
    try:
        found.draw()
    finally:  # the tables are shown even if a picture fails
        show(found.text)


def results(
    args: EpisodeArgs,
    names: Sequence[str],
    bound: bool = False,
    pictures: Mapping[str, Path] = MappingProxyType({}),
) -> Results:
    """Run contenders on the episodes.

    Args:
        args: options that choose the episodes and the tables.
        names: contenders to run; the folder of a run stands for its median training.
        bound: whether to divide RMSEs by the posterior Cramer-Rao bounds, too.
        pictures: files by option, as in :func:`~experiments.reporting.watchers.watchers`.
    """
    require_options(args, pictures)
    task, runs = task_of(args), runs_of(args, names)
    source, scoring = task.source, Scoring.of(task)
    selection = selection_of(args)
    if bound and args.planar:
        raise ValueError("bound: found with planar, whose bound there is not; expected one of them")
    files = {name: runs[name].policy if name in runs else name for name in names}
    chosen = {file: contender_of(args, file) for file in trainings(names, runs)}
    known = all_contenders(args)
    own = [name for name in names if name not in known]
    shown = {file: name for name, file in files.items()}
    everybody = [chosen[file] for file in trainings(names, runs)]
    watched = watchers(args, shown, pictures)
    found = score_contenders(
        everybody,
        source,
        args.radio,
        selection,
        watch=[watcher.add for watcher in watched],
        scoring=scoring,
        after=[*dict.fromkeys(part for watcher in watched for part in watcher.parts)],
    )
    scores = {name: found[file] for name, file in files.items()}
    if args.episodes_csv:
        write_text(args.episodes_csv, episodes_csv(scores, selection, source))
    drawn: list[Callable[[], None]] = []
    result = compare_scores(
        scores, own, scenario=source.name, radio=task.radio.name, selection=selection,
        reward=reward_name(scoring.reward),
    )  # fmt: skip
    text = str(result) + (result.terms if args.percentiles else "")
    content = result.json
    if bound:
        with progress("bound"):
            over = over_bound(scores, source, radio_from(args.radio), selection)
        text, content = text + bound_markdown(over), content | {"bound": over.json}
    if runs:
        trained = {run: [found[file] for file in run.policies] for run in runs.values()}
        seeds = over_training_seeds(trained, scores)
        text += "".join(map(seeds_markdown, seeds))
        content |= {"training_seeds": {one.run.name: one.json for one in seeds}}
    for one in watched:
        more, figures = one.told()
        text, content = text + more, content | figures
        drawn.append(one.draw)
    return Results(result, text, content, drawn)
