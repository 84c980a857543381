"""Text that others chose, such as names of files and modes, made safe to show."""

import re

from mmwave_env.lookup import printable

# What Markdown would read, or the HTML in it: no underscore in a word, no < before a number.
_READ = re.compile(
    r"[\\`*|$~]|<(?=[A-Za-z/!?])|&(?=[A-Za-z#])|\](?=[(\[:])"
    r"|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])"
)
_ESCAPED = re.compile(r"\\([\\`*|$~<&\]_])")


def printable_lines(text: str) -> str:
    """The text as of :func:`~mmwave_env.lookup.printable`, but for the ends of its lines."""
    return "\n".join(map(printable, text.split("\n")))


def escaped(text: str) -> str:
    """Plain text as Markdown that shows it letter by letter, also in a cell of a table."""
    return _READ.sub(r"\\\g<0>", printable(text))


def unescaped(markdown: str) -> str:
    """Plain text back from what :func:`escaped` made."""
    return _ESCAPED.sub(r"\1", markdown)
