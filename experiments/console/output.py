"""Output of commands: printed lines, progress bars, and tables.

Tables are Markdown or CSV. Bars, and tables with aligned columns, are shown only on a terminal.
"""

import csv
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from io import StringIO
from typing import TypeVar

from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.markdown import Markdown
from rich.progress import Progress, TextColumn, TimeElapsedColumn

from mmwave_env.io.lookup import printable

T = TypeVar("T")

QUIET: ContextVar[bool] = ContextVar("quiet", default=False)  # True: show neither bars nor tables


def bars() -> Progress:
    """Return progress bars that are drawn on standard error and vanish at the end.

    No bar is shown if standard error is not a terminal.
    """
    console = Console(stderr=True, quiet=QUIET.get())
    _, *others = Progress.get_default_columns()
    hidden = console.quiet or not console.is_terminal
    description = TextColumn("{task.description}", style="progress.description", markup=False)
    columns = description, *others, TimeElapsedColumn()
    return Progress(*columns, console=console, transient=True, disable=hidden)


def say(*lines: str) -> None:
    """Print lines in printable characters: a line break in a name becomes an escape code."""
    print(*map(printable, lines), sep="\n", flush=True)


def note(text: str) -> None:
    """Print on standard error what the program is doing."""
    Console(stderr=True, quiet=QUIET.get()).out(printable(text), highlight=False)


@contextmanager
def progress(label: str) -> Iterator[Callable[[float], None]]:
    """Show a bar; yield a function to call with the fraction of the work that is done, 0 to 1."""
    with bars() as shown:
        task = shown.add_task(printable(label), total=None)
        yield lambda share: shown.update(task, completed=share, total=1.0)


def tracked(values: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Yield values, and count them in a bar; a sequence needs no ``total``, as it has a length."""
    with bars() as shown:
        yield from shown.track(values, total=total, description=printable(label))


TABLE = re.compile(r"((?:^\|.*\n?)+)", re.MULTILINE)
CELL = re.compile(r"((?:\\.|[^|\\])*)\|")  # a cell, with the | that ends it
# Characters that are markup in Markdown or HTML. An underscore is markup only at a word's edge.
_READ = re.compile(
    r"[\\`*|$~]|<(?=[A-Za-z/!?])|&(?=[A-Za-z#])|\](?=[(\[:])"
    r"|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])"
)
_ESCAPED = re.compile(r"\\([\\`*|$~<&\]_])")


def escaped(text: str) -> str:
    """Escape plain text for Markdown, also in tables; write unprintable characters as codes."""
    return _READ.sub(r"\\\g<0>", printable(text))


def unescaped(markdown: str) -> str:
    """Return the plain text from which :func:`escaped` made this Markdown."""
    return _ESCAPED.sub(r"\1", markdown)


def cells_of(table: str) -> list[list[str]]:
    """Return the plain text of all cells of a Markdown table: header, rule and rows."""
    lines = (CELL.findall(line[1:]) for line in table.splitlines())
    return [[unescaped(cell.strip()) for cell in line] for line in lines]


def grid(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table; cells are plain text, whose special characters are escaped."""
    table = [[escaped(str(cell)) for cell in cells] for cells in (header, *rows)]
    lines = ["| " + " | ".join(cells) + " |" for cells in table]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of cells as CSV; the cell of None is empty."""
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def show(text: str) -> None:
    """Print Markdown; on a terminal, split tables that are too wide.

    Control characters, for example in a name from a file, do not reach the terminal.
    """
    console = Console()
    text = "\n".join(map(printable, text.split("\n")))
    if not console.is_terminal:
        print(text)
        return
    for part in TABLE.split(text):
        if part.startswith("|"):
            for lines in _tables(part, console.width):
                print("", *lines, "", sep="\n")
        else:
            console.print(Markdown(part))


def _tables(text: str, width: int) -> Iterator[list[str]]:
    """Split a Markdown table into tables of this width, each with the first column, as lines.

    Neither cells nor headers are wrapped.
    """
    header, _, *rows = cells_of(text)
    first, *others = zip(header, *rows, strict=True)
    group = [first]
    for column in others:
        if len(group) > 1 and cell_len(_aligned([*group, column])[0]) > width:
            yield _aligned(group)
            group = [first]
        group.append(column)
    yield _aligned(group)


def _aligned(columns: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table of columns; the first text of each column is its header."""
    widths = [max(map(cell_len, column)) for column in columns]
    rows = zip(*columns, strict=True)
    header, *lines = ["  ".join(map(set_cell_size, cells, widths)) for cells in rows]
    return [header, "─" * cell_len(header), *lines]
