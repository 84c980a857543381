"""Learning curves: how trainings came to beat what needs no training."""

import csv
from collections.abc import Sequence
from io import StringIO
from pathlib import Path

from experiments.figures.curves import draw_learning_curves
from experiments.training.evaluator import TRAINING_RIVALS
from mmwave_env.files import read_text


def curve(journal: Path, figure: str) -> tuple[list[float], list[float]]:
    """Steps and a figure of a journal, where it has both."""
    with StringIO(read_text(journal, "a journal of a training"), newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row.get(figure)]
    return [float(row["timesteps"]) for row in rows], [float(row[figure]) for row in rows]


def draw_curves(runs: Sequence[Path], path: Path) -> None:
    """Reward on tuning seeds minus that of each rival, a line a training, as a picture."""
    panels = {
        f"reward minus {rival}'s, tuning seeds": {
            str(run): [
                curve(journal, f"tuning/minus {rival}")
                for journal in sorted(run.glob("seed-*/progress.csv"))
            ]
            for run in runs
        }
        for rival in TRAINING_RIVALS
    }
    draw_learning_curves(panels, path)
