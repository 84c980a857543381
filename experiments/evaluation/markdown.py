"""Comparisons as Markdown, and as tables on a terminal."""

import math
from collections.abc import Sequence

from rich.console import Console
from rich.markdown import Markdown

from experiments.evaluation.comparison import Comparison
from experiments.evaluation.intervals import Interval
from mmwave_env.metrics import METRICS

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


def policies_table(comparison: Comparison) -> str:
    """Every policy's metrics with 95 % half-widths."""
    rows = [
        [name, *(rounded(row[metric]) for metric in METRICS)]
        for name, row in comparison.policies.items()
    ]
    return grid(["policy", *(HEADERS[metric] for metric in METRICS)], rows)


def paired_table(comparison: Comparison) -> str:
    """Paired differences of the reward: each policy minus the references."""
    pairs = [pair.rsplit(" - ", 1) for pair in comparison.paired]  # paths have any name
    references = list(dict.fromkeys(reference for _, reference in pairs))
    rows = []
    for name in comparison.policies:
        cells = []
        for reference in references:
            pair = comparison.paired.get(f"{name} - {reference}")
            cells.append(str(pair["reward"]) if pair else "")
        rows.append([name, *cells])
    return grid(["reward of", *(f"minus {reference}" for reference in references)], rows)


def markdown(comparison: Comparison) -> str:
    """A comparison as Markdown: every policy, then the paired differences of the reward."""
    c = comparison
    parts = [
        f"### {c.scenario}, {c.radio}, {c.episodes} episodes, seeds {c.seed} and up\n",
        policies_table(c),
    ]
    if c.paired:
        parts += ["\nPaired differences of the reward, 95 % intervals:\n", paired_table(c)]
    return "\n".join(parts) + "\n"


def show(text: str) -> None:
    """Print Markdown."""
    console = Console()
    if console.is_terminal:
        console.print(Markdown(text))
    else:
        print(text)
