"""Bars on a terminal, unless it is to be quiet."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from mmwave_env.lookup import printable

T = TypeVar("T")

QUIET: ContextVar[bool] = ContextVar("quiet", default=False)  # neither bars nor tables


class _Description(TextColumn):
    """What a bar is of, letter by letter: names are neither markup nor escape sequences."""

    def render(self, task: Task) -> Text:
        return Text(printable(task.description), style="progress.description")


def bars(*columns: ProgressColumn | str) -> Progress:
    """Bars that vanish at the end, on standard error: what is printed is the result alone.

    There are none where that is no terminal.

    Args:
        columns: beside rich's own.
    """
    console = Console(stderr=True, quiet=QUIET.get())
    _, *others = Progress.get_default_columns()
    return Progress(
        _Description(""), *others, *columns, console=console, transient=True,
        disable=console.quiet or not console.is_terminal,
    )  # fmt: skip


def terminal_width() -> int | None:
    """Of the terminal that is printed to; None where there is none."""
    console = Console()
    return console.width if console.is_terminal else None


def say(*lines: str) -> None:
    """Print lines, but nothing other than letters: what ends a line in a name is spelled out."""
    print(*map(printable, lines), sep="\n", flush=True)


def note(text: str) -> None:
    """Say on standard error what is going on, or where it is."""
    Console(stderr=True, quiet=QUIET.get()).out(printable(text), highlight=False)


@contextmanager
def progress(what: str) -> Iterator[Callable[[float], None]]:
    """A bar; the function takes the share done, and until its first call it only moves."""
    with bars() as shown:
        task = shown.add_task(what, total=None)
        yield lambda share: shown.update(task, completed=share, total=1.0)


def tracked(values: Iterable[T], what: str, total: int | None = None) -> Iterator[T]:
    """The values, with a bar that counts them.

    Args:
        values: to go through.
        what: they are.
        total: how many; of a sequence it is known.
    """
    with bars() as shown:
        yield from shown.track(values, total=total, description=what)
