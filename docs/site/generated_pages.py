"""Pages made from code by `make generated`: docs/environment.md, and the table of commands.md."""

import inspect
import re
from pathlib import Path

from experiments.console.main import COMMANDS
from mmwave_env.env import MmWaveLocEnv

DOCS = Path(__file__).resolve().parents[1]
PAGE_OF = {  # command -> the page about it
    "demo": "results.md",
    "localize": "own-data.md",
    "simulate": "own-log.md",
    "compare": "own-agent.md",
    "tables": "paper.md",
    "leaderboard": "benchmark.md",
    "train": "learning.md",
    "tune": "own-filters.md",
    "sweep": "sweep.md",
    "speed": "performance.md",
}


def environment_page() -> str:
    """Return environment.md: a title, a comment and the docstring of MmWaveLocEnv."""
    text = inspect.cleandoc(MmWaveLocEnv.__doc__ or "")
    made = "<!-- made from the docstring of MmWaveLocEnv by `make generated` -->"
    return f"# MmWaveLoc-v0\n\n{made}\n\n{text}\n"


def commands_page() -> str:
    """Return commands.md with a new table of commands."""
    table = "| command | what it does | more |\n|---|---|---|\n"
    for name, about in COMMANDS.items():
        page = PAGE_OF.get(name)
        table += f"| `{name}` | {about} | {f'[{page}]({page})' if page else ''} |\n"
    old = (DOCS / "commands.md").read_text("utf-8")
    return re.sub(r"\| command \|.*\n(\|.*\n)+", lambda _: table, old, count=1)


PAGES = {"environment.md": environment_page, "commands.md": commands_page}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (DOCS / name).write_text(page(), encoding="utf-8")
