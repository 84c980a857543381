"""Runs of contenders (policies and IMMs), and the tables that ``compare`` and ``demo`` print.

For a training run, a table shows the spread over training seeds (Agarwal et al. 2021).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.console.options import EpisodeArgs
from experiments.console.output import escaped, grid
from experiments.evaluation.compare import Comparison, comparison_of, episodes_csv, references
from experiments.evaluation.contenders import (
    Run,
    all_contenders,
    contender_of,
    seeds_from,
    task_of,
)
from experiments.evaluation.intervals import Interval, bootstrap, crossed_bootstrap
from experiments.evaluation.positions import EpochErrors, Positions, positions_markdown
from experiments.evaluation.runner import Scores, Scoring, score_contenders
from mmwave_env.io.files import Json, write_text
from mmwave_env.localization.levels import PARTS, Levels
from mmwave_env.numerics.numbers import Array


def over_training_seeds(run: Run, trained: Sequence[Scores], scores: Mapping[str, Scores]) -> Json:
    """Return the rewards of a run, and its gains over the reference contenders, as JSON.

    Args:
        run: the run, which has one policy per training seed.
        trained: scores of these policies, in the order of the run's seeds.
        scores: scores of all contenders, for the same episodes as ``trained``.
    """
    reward = np.stack([metrics["reward"] for metrics in trained])
    baselines = {rival: scores[rival]["reward"] for rival in references(scores)}
    minus = {rival: _figures(run, reward - baseline) for rival, baseline in baselines.items()}
    return {
        "median": run.median,
        "reward": _figures(run, reward),
        "minus": minus,
    }


def _figures(run: Run, values: Array) -> Json:
    """Return the mean of values (seeds, episodes) for each training seed, and over all seeds.

    "above_zero" is the number of seeds whose interval is above zero.
    """
    each = bootstrap(values)
    return {
        "seeds": {str(seed): mean.json for seed, mean in zip(run.seeds, each, strict=True)},
        "above_zero": sum(mean.low > 0.0 for mean in each),
        "mean": crossed_bootstrap(values).json,
    }


def seeds_markdown(run: Run, content: Json) -> str:
    """Return results of :func:`over_training_seeds` as a Markdown table.

    The table has a row for each training seed, then two rows for all seeds together.
    """
    minus = content["minus"]
    columns = [content["reward"], *minus.values()]
    header = ["training seed", "reward", *(f"minus {rival}" for rival in minus)]
    titles = {run.median: f"{run.median} (median)"}
    rows = [
        [titles.get(seed, seed), *(Interval.of(column["seeds"][str(seed)]) for column in columns)]
        for seed in run.seeds
    ]
    wins = [f"{figures['above_zero']} of {len(run.seeds)}" for figures in minus.values()]
    rows += [
        ["intervals above zero", "", *wins],
        ["mean over seeds", *(Interval.of(column["mean"]) for column in columns)],
    ]
    about = (
        f"Trainings of {escaped(run.name)}, ordered by their rewards on tuning seeds. Intervals "
        "(95 %) allow for the choice of episodes; in the last row, also for the choice of seeds:"
    )
    return f"\n{about}\n\n{grid(header, rows)}\n"


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
    known = all_contenders(args)
    own = [name for name in names if name not in known]
    runs = {name: Run.read(name) for name in own if Path(name).is_dir()}
    scoring = Scoring.of(task)
    seeds = seeds_from(args.episodes, args.seed)
    contenders = [contender_of(args, name) for name in names]
    epochs = EpochErrors()
    positions = Positions(levels, task.source.layout.anchors, args.planar)
    watch = [epochs.add] if with_epochs else []
    if args.percentiles:
        watch.append(positions.add)
    after = PARTS if args.percentiles else ()
    scores = score_contenders(contenders, task.source, seeds, watch, scoring, after)
    if args.episodes_csv:
        write_text(args.episodes_csv, episodes_csv(scores, seeds, task.source))
    comparison = comparison_of(task, seeds, scores, own)
    text = str(comparison)
    content = comparison.json
    # the same run by two names is refused here
    files = [contender_of(args, file) for run in runs.values() for file in run.policies]
    trained = score_contenders(files, task.source, seeds, scoring=scoring) if files else {}
    spreads = {}
    for name, run in runs.items():
        of_seeds = [trained[file] for file in run.policies]
        spreads[name] = over_training_seeds(run, of_seeds, scores)
        text += seeds_markdown(run, spreads[name])
    if spreads:
        content["training_seeds"] = spreads
    if args.percentiles:
        figures = content["position_errors"] = positions.figures()
        text += f"\n{positions_markdown('policy', figures['policies'], args.risk, args.levels)}"
    return Results(comparison, text, content, epochs)
