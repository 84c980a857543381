"""Runs of contenders (policies and IMMs), and the tables that ``compare`` and ``demo`` print.

For a training run, a table shows the spread over training seeds (Agarwal et al. 2021).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.console.options import CompareArgs
from experiments.console.output import escaped, grid
from experiments.evaluation.compare import Comparison, comparison_of, episodes_csv, references
from experiments.evaluation.contenders import Run, contender_of, contenders, seeds_from, task_of
from experiments.evaluation.intervals import bootstrap, crossed_bootstrap
from experiments.evaluation.positions import EpochErrors, Positions, positions_markdown
from experiments.evaluation.runner import AllScores, Scores, Scoring, score_contenders
from mmwave_env.io.files import Json, write_text
from mmwave_env.localization.levels import PARTS, Levels


def over_training_seeds(
    name: str, trained: Sequence[Scores], scores: AllScores
) -> tuple[Json, str]:
    """Return figures of a run's rewards, and of its gains over the reference contenders.

    A figure is the mean over all training seeds, with an interval for the choice of episodes and of
    seeds. "above_zero" is the number of seeds whose own interval is above zero.

    Args:
        name: name of the run.
        trained: scores of the policies of all seeds.
        scores: scores of all contenders, for the same episodes.

    Returns:
        The figures as JSON, and as a Markdown table.
    """
    reward = np.stack([metrics["reward"] for metrics in trained])
    columns = {"reward": reward}
    for rival in references(scores):
        columns[f"minus {rival}"] = reward - scores[rival]["reward"]
    content = {}
    wins = []
    means = []
    for column, values in columns.items():
        mean = crossed_bootstrap(values)
        above = sum(each.low > 0.0 for each in bootstrap(values))
        content[column] = {"mean": mean.json, "above_zero": above}
        wins.append("" if column == "reward" else f"{above} of {len(trained)}")
        means.append(mean)
    table = grid(
        ["training seed", *columns],
        [["intervals above zero", *wins], ["mean over seeds", *means]],
    )
    about = (
        f"Trainings of {escaped(name)}, all seeds together. Intervals (95 %) allow for the choice "
        "of episodes; in the last row, also for the choice of seeds:"
    )
    return content, f"\n{about}\n\n{table}\n"


def results(args: CompareArgs) -> tuple[Comparison, str, Json, EpochErrors]:
    """Run the chosen contenders, or all of them, on the episodes that options select.

    If a name is the folder of a training run, its policy with the median reward is the contender.

    Returns:
        The comparison; all tables as Markdown; all results, in the form that results files store;
        and errors of all epochs if a picture needs them.

    Raises:
        ValueError: an option is not valid.
    """
    levels = Levels(args.risk, args.levels)
    task = task_of(args)
    known = contenders(args.radio, args.modes or None)
    names = args.policies or (*known,)
    own = [name for name in names if name not in known]
    runs = {name: Run.read(name) for name in own if Path(name).is_dir()}
    scoring = Scoring.of(task)
    seeds = seeds_from(args.episodes, args.seed)
    everybody = [contender_of(args, name) for name in names]
    epochs = EpochErrors()
    positions = Positions(levels, task.source.layout.anchors, args.planar)
    watch = [epochs.add] if args.errors or args.consistency else []
    if args.percentiles:
        watch.append(positions.add)
    after = PARTS if args.percentiles else ()
    scores = score_contenders(everybody, task.source, seeds, watch, scoring, after)
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
        spreads[name], table = over_training_seeds(name, of_seeds, scores)
        text += table
    if spreads:
        content["training_seeds"] = spreads
    if args.percentiles:
        figures = content["position_errors"] = positions.figures()
        text += f"\n{positions_markdown('policy', figures['policies'], args.risk, args.levels)}"
    return comparison, text, content, epochs
