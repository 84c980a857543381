"""Escaping of text that others chose, such as names of files and modes."""

import re

from mmwave_env.io.lookup import printable

# Characters that are markup in Markdown or HTML; _ within a word and < before a number are not.
_READ = re.compile(
    r"[\\`*|$~]|<(?=[A-Za-z/!?])|&(?=[A-Za-z#])|\](?=[(\[:])"
    r"|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])"
)
_ESCAPED = re.compile(r"\\([\\`*|$~<&\]_])")


def printable_lines(text: str) -> str:
    """Return text as :func:`~mmwave_env.io.lookup.printable` does, but keep the line breaks."""
    return "\n".join(map(printable, text.split("\n")))


def escaped(text: str) -> str:
    """Return plain text as Markdown that shows every character, even in a cell of a table."""
    return _READ.sub(r"\\\g<0>", printable(text))


def unescaped(markdown: str) -> str:
    """Return the plain text that :func:`escaped` was given."""
    return _ESCAPED.sub(r"\1", markdown)
