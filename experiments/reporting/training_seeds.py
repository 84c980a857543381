"""Spread of a learned policy's results over training seeds (Agarwal et al. 2021)."""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.console.tables import escaped, grid
from experiments.evaluation.comparison import references
from experiments.evaluation.intervals import Interval, bootstrap, crossed_bootstrap
from experiments.evaluation.runner import Scores
from experiments.evaluation.runs import Run
from mmwave_env.io.files import Json
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
    imms = [rival for rival in baselines if rival.startswith("imm")]
    minus = {rival: _figures(run, reward - baseline) for rival, baseline in baselines.items()}
    return {
        "median": run.median,
        "best_imm": max(imms, key=lambda imm: float(baselines[imm].mean()), default=None),
        "reward": _figures(run, reward),
        "minus": minus,
    }


def _figures(run: Run, values: Array) -> Json:
    """Return the mean of values (seeds, episodes) for each training seed, and over all seeds.

    "above_zero" is the number of seeds whose interval is above zero.
    """
    each = bootstrap(values.T)
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
    best = {content["best_imm"]: " (best IMM)"}
    columns = [content["reward"], *minus.values()]
    header = ["training seed", "reward", *(f"minus {r}{best.get(r, '')}" for r in minus)]
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
