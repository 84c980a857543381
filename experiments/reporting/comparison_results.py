"""Runs of contenders (policies and IMMs), and the tables that ``compare`` and ``demo`` print."""

from collections.abc import Sequence
from typing import NamedTuple

from experiments.console.options import EpisodeArgs
from experiments.evaluation.asked import (
    all_contenders,
    contender_of,
    runs_of,
    task_of,
)
from experiments.evaluation.comparison import Comparison, compare_scores, episodes_csv
from experiments.evaluation.positions import Positions, positions_markdown
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.seeds import seeds_from
from experiments.reporting.histories import EpochErrors
from experiments.reporting.training_seeds import over_training_seeds, seeds_markdown
from mmwave_env.interface.reward import reward_name
from mmwave_env.io.files import Json, write_text
from mmwave_env.localization.levels import PARTS, Levels


class Results(NamedTuple):
    """Results of a comparison: tables, values, and errors for pictures."""

    comparison: Comparison
    text: str  # all tables as Markdown
    json: Json  # all results, in the form that results files store
    epochs: EpochErrors  # errors of all epochs if they were asked for


def results(args: EpisodeArgs, names: Sequence[str], with_epochs: bool = False) -> Results:
    """Run contenders on the episodes that options select.

    If a name is the folder of a training run, its policy with the median reward is the contender.

    Raises:
        ValueError: an option is not valid.
    """
    levels = Levels(args.risk, args.levels)
    task = task_of(args)
    runs = runs_of(args, names)
    scoring = Scoring.of(task)
    seeds = seeds_from(args.episodes, args.seed)
    others = [file for run in runs.values() for file in run.policies if file != run.policy]
    epochs = EpochErrors(names)
    positions = Positions(names, levels, task.source.layout.anchors, args.planar)
    watch = [epochs.add] if with_epochs else []
    if args.percentiles:
        watch.append(positions.add)
    scores_of = score_contenders(
        [contender_of(args, name) for name in (*names, *others)],
        task.source,
        seeds,
        watch=watch,
        scoring=scoring,
        after=PARTS if args.percentiles else (),
    )
    scores = {name: scores_of[name] for name in names}
    if args.episodes_csv:
        write_text(args.episodes_csv, episodes_csv(scores, seeds, task.source))
    known = all_contenders(args)
    comparison = compare_scores(
        scores,
        [name for name in names if name not in known],
        scenario=task.source.name,
        radio=task.radio.name,
        seeds=seeds,
        reward=reward_name(scoring.reward),
    )
    text = str(comparison)
    content = comparison.json
    if runs:
        content["training_seeds"] = {}
    for run in runs.values():
        trained = [scores_of[run.name if file == run.policy else file] for file in run.policies]
        spread = content["training_seeds"][run.name] = over_training_seeds(run, trained, scores)
        text += seeds_markdown(run, spread)
    if args.percentiles:
        figures = content["position_errors"] = positions.figures()
        text += f"\n{positions_markdown('policy', figures['policies'], args.risk, args.levels)}"
    return Results(comparison, text, content, epochs)
