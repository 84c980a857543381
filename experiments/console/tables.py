"""Text and tables of results, as Markdown, as LaTeX and on a terminal."""

import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest

from rich.cells import cell_len
from rich.console import Console
from rich.markdown import Markdown

from mmwave_env.io.lookup import printable

TABLE = re.compile(r"((?:^\|.*\n?)+)", re.MULTILINE)
CELL = re.compile(r"((?:\\.|[^|\\])*)\|")  # a cell, with the | that ends it
UNIT = re.compile(r" (?=(?:m|s|%)(?: |$))")  # the space before a unit, where a line must not break
GLUED = "\u00a0"  # a space where :mod:`textwrap` does not break
GAP = 2  # spaces between columns
# Characters that are markup in Markdown or HTML. An underscore is markup only at a word's edge.
_READ = re.compile(
    r"[\\`*|$~]|<(?=[A-Za-z/!?])|&(?=[A-Za-z#])|\](?=[(\[:])"
    r"|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])"
)
_LATEX = str.maketrans(
    {char: rf"\{char}" for char in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"±": r"$\pm$"}
)
_MINUS = re.compile(r"(?<![\w-])-(?=\d)")
_ESCAPED = re.compile(r"\\([\\`*|$~<&\]_])")


def printable_lines(text: str) -> str:
    """Return text with unprintable characters as escape codes, but keep the line breaks."""
    return "\n".join(map(printable, text.split("\n")))


def escaped(text: str) -> str:
    """Escape plain text for Markdown, also in tables; write unprintable characters as codes."""
    return _READ.sub(r"\\\g<0>", printable(text))


def unescaped(markdown: str) -> str:
    """Return the plain text from which :func:`escaped` made this Markdown."""
    return _ESCAPED.sub(r"\1", markdown)


def grid(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table; cells are plain text, whose special characters are escaped."""
    table = [[escaped(str(cell)) for cell in cells] for cells in (header, *rows)]
    lines = ["| " + " | ".join(cells) + " |" for cells in table]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])


def booktabs(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return plain-text cells as a LaTeX ``tabular`` in the style of the package booktabs."""
    head, *body = (
        " & ".join(_MINUS.sub("$-$", printable(str(cell)).translate(_LATEX)) for cell in cells)
        for cells in (header, *rows)
    )
    lines = [rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}", r"\toprule", head + r" \\"]
    lines += [r"\midrule", *(row + r" \\" for row in body), r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def show(text: str) -> None:
    """Print Markdown; on a terminal, split tables that are too wide.

    Control characters, for example in a name from a file, do not reach the terminal.
    """
    console = Console()
    text = printable_lines(text)
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
    """Split a Markdown table into tables that fit a width; yield the lines of each.

    Every table repeats the first column. Headers are wrapped at spaces; cells are never wrapped.
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
    """Return the lines of a table whose first row is the header."""
    wrapped = [
        [line.replace(GLUED, " ") for line in textwrap.wrap(title, n)]
        for title, n in zip(rows[0], widths, strict=True)
    ]
    header = zip_longest(*wrapped, fillvalue="")
    rule = ["─" * (sum(widths) + GAP * (len(widths) - 1))]
    return [*_aligned(header, widths), *rule, *_aligned(rows[1:], widths)]


def _aligned(rows: Iterable[Sequence[str]], widths: Sequence[int]) -> list[str]:
    return [
        (" " * GAP)
        .join(cell + " " * (n - cell_len(cell)) for cell, n in zip(row, widths, strict=True))
        .rstrip()
        for row in rows
    ]
