"""Figures as Markdown, and as tables on a terminal."""

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

from rich.cells import cell_len
from rich.console import Console
from rich.markdown import Markdown

from experiments.console.text import escaped, printable_lines, unescaped

HEADERS = {
    "reward": "reward", "ate_m": "ATE m", "rmse_m": "RMSE m", "rpe_m": "RPE m", "nees": "NEES",
    "in_bounds": "in 95 % bounds", "divergence_rate": "diverged", "error_term": "error term",
    "nees_term": "NEES term",
}  # fmt: skip


TABLE = re.compile(r"((?:^\|.*\n?)+)", re.MULTILINE)
CELL = re.compile(r"((?:\\.|[^|\\])*)\|")  # with the bar behind it
UNIT = re.compile(r" (?=(?:m|s|%)(?: |$))")  # the space before a unit, where no line ends
GLUED = "\u00a0"  # a space that is none to :mod:`textwrap`
GAP = 2  # between columns


class Table(NamedTuple):
    """What a table says, whatever it is written as."""

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]


def grid(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table of plain text, which may hold anything."""
    table = [[escaped(str(cell)) for cell in cells] for cells in (header, *rows)]
    lines = ["| " + " | ".join(cells) + " |" for cells in table]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])


def show(text: str) -> None:
    """Print Markdown; on a terminal, tables that are too wide go on below.

    Nothing in it reaches the terminal but letters, not even from names of others.
    """
    console, text = Console(), printable_lines(text)
    if not console.is_terminal:
        print(text)
        return
    for part in TABLE.split(text):
        if part.startswith("|"):
            for lines in _tables(part, console.width):
                console.out("", *lines, "", sep="\n", highlight=False)
        else:
            console.print(Markdown(part))


def _tables(text: str, width: int) -> Iterator[list[str]]:
    """Lines of the tables that a Markdown table becomes on a terminal of a width.

    Each has the first column. Headers are folded at their spaces, cells never.
    """
    lines = (
        [unescaped(cell.strip()) for cell in CELL.findall(line[1:])] for line in text.splitlines()
    )
    header, _, *rows = lines
    header = [UNIT.sub(GLUED, title) for title in header]
    needed = [
        max(map(cell_len, [*column, *title.split(" ")]))
        for title, *column in zip(header, *rows, strict=True)
    ]
    parts = [[0]]
    for i in range(1, len(header)):
        if len(parts[-1]) > 1 and sum(needed[k] + GAP for k in (*parts[-1], i)) - GAP > width:
            parts.append([0])
        parts[-1].append(i)
    for part in parts:
        yield _table([[row[k] for k in part] for row in (header, *rows)], [needed[k] for k in part])


def _table(rows: Sequence[Sequence[str]], widths: Sequence[int]) -> list[str]:
    """Lines of a table, the first row of which is the header."""
    folded = [
        [line.replace(GLUED, " ") for line in textwrap.wrap(title, n)]
        for title, n in zip(rows[0], widths, strict=True)
    ]
    header = zip_longest(*folded, fillvalue="")
    rule = ["─" * (sum(widths) + GAP * (len(widths) - 1))]
    return [*_aligned(header, widths), *rule, *_aligned(rows[1:], widths)]


def _aligned(rows: Iterable[Sequence[str]], widths: Sequence[int]) -> list[str]:
    return [
        (" " * GAP)
        .join(cell + " " * (n - cell_len(cell)) for cell, n in zip(row, widths, strict=True))
        .rstrip()
        for row in rows
    ]
