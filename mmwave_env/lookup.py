"""Looking things up by name, with an error that lists the valid names."""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import TypeVar

T = TypeVar("T")


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
    return f"{what}: found {name!r}, expected one of {', '.join(names)}{did_you_mean(name, names)}"


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a message that names the closest of the names known; empty if none is close."""
    close = get_close_matches(name, list(known), 1) if isinstance(name, str) else []
    return f"; did you mean {close[0]}?" if close else ""
