"""Where things lie in the checkout, how long examples of its pages run, and what tables say."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOGS = ROOT / "mmwave_env" / "data" / "logs"
RECORDINGS = ROOT / "mmwave_env" / "data" / "deepmimo_canyon28"


def shortened(example: str) -> str:
    """An example that trains, with 4096 steps and 2 test episodes."""
    for word, few in (("total_timesteps", "4_096"), ("episodes", "2")):
        example, count = re.subn(rf"{word}=[\d_]+", f"{word}={few}", example)
        assert count == 1, word
    return example


def numbers(text: str) -> list[float]:
    """Every number of the tables in a page or a print, in order."""
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [float(n) for row in rows for n in re.findall(r"-?\d+(?:\.\d+)?", row)]
