"""Looking things up by name, with an error that lists the valid names or says how to get it."""

import importlib.util
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
