"""Pages made from code by `make generated`: docs/environment.md, and the table of commands.md."""

import inspect
import re
from pathlib import Path

from experiments.console.main import COMMANDS
from mmwave_env.env import MmWaveLocEnv

PAGE = Path(__file__).resolve().parents[1] / "environment.md"
LISTED = PAGE.with_name("commands.md")
MORE = {  # the page about a command
    "demo": "results", "localize": "data", "simulate": "own-log", "compare": "own-agent",
    "tables": "paper", "leaderboard": "benchmark", "train": "learning", "tune": "own-filters",
    "sweep": "sweep", "convert": "own-agent", "speed": "performance",
}  # fmt: skip


def page() -> str:
    """Return the page: a title, a comment and the docstring of the class."""
    text = inspect.cleandoc(MmWaveLocEnv.__doc__ or "")
    made = "<!-- made from the docstring of MmWaveLocEnv by `make generated` -->"
    return f"# MmWaveLoc-v0\n\n{made}\n\n{text}\n"


def listed() -> str:
    """Return the page of the commands with a table of all commands."""
    more = {name: f"[{page}.md]({page}.md)" for name, page in MORE.items()}
    rows = [f"| `{name}` | {about} | {more.get(name, '')} |\n" for name, about in COMMANDS.items()]
    table = f"| command | what it does | more |\n|---|---|---|\n{''.join(rows)}"
    return re.sub(
        r"\| command \|(.*\n\|)*.*\n", lambda _: table, LISTED.read_text("utf-8"), count=1
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    LISTED.write_text(listed(), encoding="utf-8")
