"""Comparisons as Markdown, and as tables on a terminal."""

from rich.console import Console
from rich.markdown import Markdown

from experiments.evaluation import Comparison, Interval
from mmwave_env.metrics import METRICS

HEADERS = {
    "reward": "reward", "ate_m": "ATE m", "rmse_m": "RMSE m", "rpe_m": "RPE m", "nees": "NEES",
    "in_bounds": "in 95 % bounds", "divergence_rate": "diverged",
}  # fmt: skip


def table(rows: dict[str, dict[str, Interval]], first: str) -> str:
    """A Markdown table of intervals, one row a name."""
    lines = [f"| {first} | " + " | ".join(HEADERS[m] for m in METRICS) + " |"]
    lines.append("|---" * (len(METRICS) + 1) + "|")
    for name, row in rows.items():
        lines.append(f"| {name} | " + " | ".join(str(row[m]) for m in METRICS) + " |")
    return "\n".join(lines)


def markdown(comparison: Comparison) -> str:
    """A comparison as Markdown: every policy, then the paired differences."""
    c = comparison
    title = f"### {c.scenario}, {c.radio}, {c.episodes} episodes, seeds {c.seed} and up\n"
    parts = [title, table(c.policies, "policy")]
    if c.paired:
        parts += ["\nPaired differences, episode by episode:\n", table(c.paired, "difference")]
    return "\n".join(parts) + "\n"


def show(comparison: Comparison) -> None:
    """Print a comparison."""
    console = Console()
    if console.is_terminal:
        console.print(Markdown(markdown(comparison)))
    else:
        print(markdown(comparison))
