"""HTML of text that others chose, and tables that a phone shows as cards."""

import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, NamedTuple

from experiments.evaluation.intervals import Interval, rounded
from mmwave_env.lookup import printable


class Cell(NamedTuple):
    """What a cell shows, and the number behind it, unrounded."""

    shown: str
    value: float | None = None


SEPARATOR = re.compile("[/:](?=.)")  # names of files and places may be broken behind these
BRACKETS = re.compile(r"\[[-\d., ]+\]|\([\w-]+\)")
Written = str | Interval | Cell  # what may stand in a table


def text(value: Any) -> str:
    """Plain text as HTML that shows it letter by letter, also in a quoted attribute."""
    return escape(printable(str(value)))


def short(figures: dict[str, Any]) -> Cell:
    """Mean and half the width of the interval, as commands print it."""
    return Cell(rounded(Interval.of(figures)), figures["mean"])


def whole(figures: dict[str, Any] | None) -> Cell:
    """Mean and interval, as commands print it; nothing of none."""
    return _cell(Interval.of(figures) if figures else "")


def table(caption: str, header: Sequence[str], rows: Iterable[Sequence[Written]]) -> str:
    """A table of plain text; the first cell of a row names it.

    On a narrow screen rows become cards, whose cells say what they are; roles keep it a table for
    whoever listens to it.
    """
    head = "".join(f'<th scope="col" role="columnheader">{text(one)}</th>' for one in header)
    body = "".join(f'<tr role="row">{_row(header, row)}</tr>' for row in rows)
    return (
        f'<table role="table"><caption>{text(caption)}</caption>'
        f'<thead role="rowgroup"><tr role="row">{head}</tr></thead>'
        f'<tbody role="rowgroup">{body}</tbody></table>'
    )


def _unbroken(cell: Cell) -> str:
    """What a cell shows, with no line break inside brackets."""
    found = BRACKETS.sub(r'<span class="whole">\g<0></span>', text(cell.shown))
    return f"<span>{found}</span>" if "<span" in found else found


def _cell(given: Written) -> Cell:
    """Numbers of an interval are those that commands print."""
    if isinstance(given, Interval):
        return Cell(str(given), given.mean)
    return given if isinstance(given, Cell) else Cell(given)


def _row(header: Sequence[str], row: Sequence[Written]) -> str:
    cells = []
    for number, (title, given) in enumerate(zip(header, row, strict=True)):
        cell = _cell(given)
        value = "" if cell.value is None else f' data-value="{cell.value!r}"'
        if number == 0:
            name = SEPARATOR.sub(r"\g<0><wbr>", text(cell.shown))
            cells.append(f'<th scope="row" role="rowheader"{value}>{name}</th>')
        else:
            empty = "" if cell.shown else ' class="empty"'
            cells.append(
                f'<td role="cell" data-title="{text(title)}"{value}{empty}>{_unbroken(cell)}</td>'
            )
    return "".join(cells)


def paragraph(words: str, kind: str = "") -> str:
    """A paragraph of plain text."""
    return f'<p class="{kind}">{text(words)}</p>' if kind else f"<p>{text(words)}</p>"


def heading(words: str, level: int = 3) -> str:
    """A heading of plain text."""
    return f"<h{level}>{text(words)}</h{level}>"


def folded(title: str, parts: Iterable[str]) -> str:
    """What is shown on demand."""
    return f"<details><summary>{text(title)}</summary>{''.join(parts)}</details>"


def chart(kind: str, **data: str | int) -> str:
    """The place of a picture that the page's script draws from its data."""
    said = "".join(f' data-{name}="{text(value)}"' for name, value in data.items())
    return f'<div class="chart" data-chart="{text(kind)}"{said}></div>'
