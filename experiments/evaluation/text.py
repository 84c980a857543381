"""Text that others chose, such as names of files and modes, made safe to show; lists of names."""

import re
import textwrap
from collections.abc import Mapping

# What Markdown would read, or the HTML in it: no underscore in a word, no < before a number.
_READ = re.compile(
    r"[\\`*|$~]|<(?=[A-Za-z/!?])|&(?=[A-Za-z#])|\](?=[(\[:])"
    r"|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])"
)
_ESCAPED = re.compile(r"\\([\\`*|$~<&\]_])")


def printable(text: str) -> str:
    """The text with what has no look of its own (escape sequences, line ends) spelled out."""
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape", "surrogatepass").decode()
        for one in text
    )


def printable_lines(text: str) -> str:
    """The same, but for the ends of its lines."""
    return "\n".join(map(printable, text.split("\n")))


def entries(found: Mapping[str, str], column: int, width: int | None = None) -> list[str]:
    """Lines of names and what they mean.

    Args:
        found: meanings by name.
        column: where meanings begin.
        width: that lines are folded at, their rest below the meaning; None for whole lines.
    """
    lines = [f"  {name:{column - 3}} {what}" for name, what in found.items()]
    if width is None:
        return lines
    fold = textwrap.TextWrapper(
        width, subsequent_indent=" " * column, break_long_words=False, break_on_hyphens=False
    )
    return [folded for line in lines for folded in fold.wrap(line)]


def escaped(text: str) -> str:
    """Plain text as Markdown that shows it letter by letter, also in a cell of a table."""
    return _READ.sub(r"\\\g<0>", printable(text))


def unescaped(markdown: str) -> str:
    """Plain text back from what :func:`escaped` made."""
    return _ESCAPED.sub(r"\1", markdown)
