"""Figures as Markdown, and as tables on a terminal."""

import math
from collections.abc import Sequence

from rich.console import Console
from rich.markdown import Markdown

from experiments.evaluation.intervals import Interval

HEADERS = {
    "reward": "reward", "ate_m": "ATE m", "rmse_m": "RMSE m", "rpe_m": "RPE m", "nees": "NEES",
    "in_bounds": "in 95 % bounds", "divergence_rate": "diverged",
}  # fmt: skip


def rounded(interval: Interval) -> str:
    """Mean and half the width of the interval, to the digits that the interval supports."""
    half = (interval.high - interval.low) / 2.0
    digits = 3 if half <= 0.0 else min(4, max(0, 1 - math.floor(math.log10(half))))
    return f"{interval.mean:.{digits}f} ± {half:.{digits}f}"


def grid(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (header, *rows)]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])


def show(text: str) -> None:
    """Print Markdown."""
    console = Console()
    if console.is_terminal:
        console.print(Markdown(text))
    else:
        print(text)
