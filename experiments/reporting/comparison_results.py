"""Runs of contenders (policies and IMMs), and the tables that ``compare`` and ``demo`` print."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from experiments.console.options import EpisodeArgs
from experiments.evaluation.asked import (
    all_contenders,
    contender_of,
    runs_of,
    selection_of,
    task_of,
)
from experiments.evaluation.comparison import Comparison, compare_scores, episodes_csv
from experiments.evaluation.histories import EpochErrors
from experiments.evaluation.positions import Positions, positions_markdown
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.runs import trainings
from experiments.figures.canvas import require_picture
from experiments.figures.curves import draw_consistency, draw_error_cdf
from experiments.reporting.training_seeds import over_training_seeds, seeds_markdown
from mmwave_env.interface.reward import reward_name
from mmwave_env.io.files import Json, write_text
from mmwave_env.localization.levels import PARTS, Levels

WIDTH_MM = (80.0, 500.0)  # smallest and largest width of a readable picture


class Results(NamedTuple):
    """Results of a comparison: tables, values, and pictures to draw."""

    comparison: Comparison
    text: str  # all tables as Markdown
    json: Json  # all results, in the form that results files store
    pictures: Sequence[Callable[[], None]]  # functions that each write a picture


def results(
    args: EpisodeArgs,
    names: Sequence[str],
    pictures: Mapping[str, Path] = MappingProxyType({}),
    width_mm: float | None = None,
) -> Results:
    """Run contenders on the episodes that options select.

    If a name is the folder of a training run, its policy with the median reward is the contender.
    ``pictures`` maps "errors" and "consistency" to files; ``width_mm`` is the pictures' width.

    Raises:
        ValueError: an option is not valid, or both pictures have the same file.
        OSError: a picture can't be written.
    """
    levels = Levels(args.risk, args.levels)
    if width_mm is not None and not WIDTH_MM[0] <= width_mm <= WIDTH_MM[1]:
        raise ValueError(
            f"width_mm: found {width_mm:g}, expected {WIDTH_MM[0]:g} to {WIDTH_MM[1]:g}"
        )
    for option, path in pictures.items():
        require_picture(option, path)
    if len(set(pictures.values())) < len(pictures):
        raise ValueError(f"consistency: found {path}, expected a file other than the --errors file")
    task = task_of(args)
    runs = runs_of(args, names)
    scoring = Scoring.of(task)
    selection = selection_of(args)
    files = {name: runs[name].policy if name in runs else name for name in names}
    shown = {file: name for name, file in files.items()}
    epochs = EpochErrors(shown)
    positions = Positions(shown, levels, task.source.layout.anchors, args.planar)
    scores_of = score_contenders(
        [contender_of(args, file) for file in trainings(names, runs)],
        task.source,
        args.radio,
        selection,
        watch=[epochs.add] * bool(pictures) + [positions.add] * args.percentiles,
        scoring=scoring,
        after=PARTS * args.percentiles,
    )
    scores = {name: scores_of[file] for name, file in files.items()}
    if args.episodes_csv:
        write_text(args.episodes_csv, episodes_csv(scores, selection, task.source))
    known = all_contenders(args)
    comparison = compare_scores(
        scores,
        [name for name in names if name not in known],
        scenario=task.source.name,
        radio=task.radio.name,
        selection=selection,
        reward=reward_name(scoring.reward),
    )
    text = str(comparison) + comparison.terms * args.percentiles
    content = comparison.json
    if runs:
        content["training_seeds"] = {}
    for run in runs.values():
        trained = [scores_of[file] for file in run.policies]
        spread = content["training_seeds"][run.name] = over_training_seeds(run, trained, scores)
        text += seeds_markdown(run, spread)
    if args.percentiles:
        figures = content["position_errors"] = positions.figures()
        rows = figures["policies"]
        text += f"\n{positions_markdown('policy', rows, args.risk, args.levels)}"
    drawings: dict[str, Callable[[], None]] = {
        "errors": lambda: draw_error_cdf(epochs.errors_m, pictures["errors"], width_mm),
        "consistency": lambda: draw_consistency(
            epochs.time_s, epochs.nees, 2 if args.planar else 3, pictures["consistency"], width_mm
        ),
    }
    return Results(comparison, text, content, [drawings[name] for name in pictures])
