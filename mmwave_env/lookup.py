"""Names: what they may be, how they are shown, and looking things up by them.

Errors list the valid ones, or say how to get what is missing.
"""

import importlib.util
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import TypeVar

T = TypeVar("T")
LONGEST = 80  # letters of a name, and of a value that a message quotes


# --- names of others


def spelled(letter: str) -> str:
    """A letter by its code, in place of what has no look of its own."""
    return letter.encode("unicode_escape", "surrogatepass").decode("ascii")


def printable(text: str) -> str:
    """The text with what has no look of its own (escape sequences, line ends) spelled out."""
    return "".join(one if one.isprintable() else spelled(one) for one in text)


def is_name(value: object) -> bool:
    """Whether it can stand in tables and pictures as it is."""
    return isinstance(value, str) and 1 <= len(value) <= LONGEST and value.isprintable()


def as_name(text: str) -> str:
    """What a file or a folder is called, as a name: spelled out where need be, and cut."""
    return printable(text)[:LONGEST] or "unnamed"


def as_cell(name: str) -> str:
    """A name for a CSV table, where spreadsheets take it for text and not for a formula."""
    return f"'{name}" if name.startswith(("=", "+", "-", "@", "\t", "\r")) else name


def quoted(value: object) -> str:
    """A value as messages quote it, cut where it is long."""
    shown = repr(value)
    return shown if len(shown) <= LONGEST else f"{shown[: LONGEST - 3]}..."


# --- looked up


def choose(options: Mapping[str, T], name: str, what: str) -> T:
    """``options[name]``.

    Raises:
        ValueError: unknown name; the message lists the valid ones.
    """
    if not isinstance(name, str) or name not in options:
        raise ValueError(unknown(what, name, options))
    return options[name]


def unknown(what: str, name: object, known: Iterable[str]) -> str:
    """The message about a name that is none of those that are known."""
    names = list(known)
    hint = did_you_mean(name, names)
    begin = f"{hint.removeprefix('; ')} E" if hint else "e"
    return f"{what}: found {quoted(name)}, {begin}xpected one of {', '.join(names)}"


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a message that names the closest of the names known; empty if none is close."""
    typed = isinstance(name, str) and len(name) <= LONGEST
    close = get_close_matches(str(name), list(known), 1) if typed else []
    return f"; did you mean {close[0]}?" if close else ""


class MissingExtraError(ImportError, ValueError):
    """A package is not installed that an extra of ours brings.

    An ImportError in Python; a wrong argument to commands, which end with its one line.
    """


def require_extra(package: str, extra: str, what: str) -> None:
    """Refuse what needs a package that is not installed, before any work.

    Args:
        package: its name, as it is imported.
        extra: of mmwave-loc, which brings it.
        what: needs it.

    Raises:
        MissingExtraError: the package is not installed; the message says how to get it.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingExtraError(f"{what} needs {package}: pip install 'mmwave-loc[{extra}]'")
