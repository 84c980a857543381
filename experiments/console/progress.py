"""Printed lines and progress bars; the bars are shown only on a terminal."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress, ProgressColumn, TextColumn

from mmwave_env.io.lookup import printable

T = TypeVar("T")

QUIET: ContextVar[bool] = ContextVar("quiet", default=False)  # True: show neither bars nor tables


def bars(*columns: ProgressColumn | str) -> Progress:
    """Return progress bars that are drawn on standard error and vanish at the end.

    No bar is shown if standard error is not a terminal. ``columns`` follow rich's default columns.
    """
    console = Console(stderr=True, quiet=QUIET.get())
    _, *others = Progress.get_default_columns()
    hidden = console.quiet or not console.is_terminal
    description = TextColumn("{task.description}", style="progress.description", markup=False)
    all_columns = description, *others, *columns
    return Progress(*all_columns, console=console, transient=True, disable=hidden)


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
