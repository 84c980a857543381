"""Learning curves: how trainings came to beat what needs no training."""

import csv
from collections.abc import Sequence
from pathlib import Path

from experiments.evaluation.colors import COLORS
from experiments.training.evaluator import TRAINING_RIVALS
from mmwave_env.files import atomic_path


def curve(journal: Path, figure: str) -> tuple[list[float], list[float]]:
    """Steps and a figure of a journal, where it has both."""
    with journal.open(encoding="utf-8", newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row.get(figure)]
    return [float(row["timesteps"]) for row in rows], [float(row[figure]) for row in rows]


def draw_curves(runs: Sequence[Path], path: Path) -> None:
    """Reward on tuning seeds minus that of each rival, a line a training, as PNG."""
    from matplotlib.figure import Figure

    picture = Figure(figsize=(11.0, 4.2), layout="constrained")
    for axes, rival in zip(picture.subplots(1, len(TRAINING_RIVALS)), TRAINING_RIVALS, strict=True):
        for run, color in zip(runs, COLORS, strict=False):
            label = run.name
            for journal in sorted(run.glob("seed-*/progress.csv")):
                steps, gain = curve(journal, f"tuning/minus {rival}")
                axes.plot(steps, gain, color=color, lw=1.0, alpha=0.8, label=label)
                label = ""
        axes.axhline(0.0, color="black", lw=0.8)
        axes.set(xscale="log", xlabel="steps", ylabel=f"reward minus {rival}'s, tuning seeds")
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
    with atomic_path(path) as temporary:
        picture.savefig(temporary, dpi=120)
