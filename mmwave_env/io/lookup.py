"""Functions that check names, show them, and look up values by name.

Errors list the valid names, or say how to install a missing package.
"""

import importlib.util
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import TypeVar

T = TypeVar("T")
LONGEST = 80  # maximum length of a name, and of a value that a message quotes


def printable(text: str) -> str:
    """Return the text with unprintable characters, such as line ends, as escape codes."""
    return "".join(
        letter
        if letter.isprintable()
        else letter.encode("unicode_escape", "surrogatepass").decode("ascii")
        for letter in text
    )


def is_name(value: object) -> bool:
    """Tell whether a value is a name that can be shown unchanged in tables and pictures."""
    return isinstance(value, str) and 1 <= len(value) <= LONGEST and value.isprintable()


def as_name(text: str) -> str:
    """Return the name of a file or folder as a valid name: escaped, and cut if it is too long."""
    return printable(text)[:LONGEST] or "unnamed"


def as_cell(name: str) -> str:
    """Return a name as a CSV cell that spreadsheets read as text, not as a formula."""
    return f"'{name}" if name.startswith(("=", "+", "-", "@", "\t", "\r")) else name


def quoted(value: object) -> str:
    """Return a value as messages quote it, cut if it is long."""
    shown = repr(value)
    return shown if len(shown) <= LONGEST else f"{shown[: LONGEST - 3]}..."


def choose(options: Mapping[str, T], name: str, field: str, other: str = "") -> T:
    """Return ``options[name]``.

    Raises:
        ValueError: the name is unknown; the message lists the valid names, and ends with ``other``.
    """
    if not isinstance(name, str) or name not in options:
        raise ValueError(unknown(field, name, options) + other)
    return options[name]


def unknown(field: str, name: object, known: Iterable[str]) -> str:
    """Return the error message for an unknown name."""
    names = list(known)
    hint = did_you_mean(name, names)
    begin = f"{hint.removeprefix('; ')} E" if hint else "e"
    return f"{field}: found {quoted(name)}, {begin}xpected one of {', '.join(names)}"


def did_you_mean(name: object, known: Iterable[str], most: int = 1) -> str:
    """Return the end of a message that suggests up to ``most`` close names; "" if none is close."""
    typed = isinstance(name, str) and len(name) <= LONGEST
    close = get_close_matches(str(name), list(known), most) if typed else []
    return f"; did you mean {' or '.join(close)}?" if close else ""


class MissingExtraError(ImportError, ValueError):
    """Error for a missing package that an extra of this project installs.

    It is also a ValueError, because commands print a ValueError in one line, without a traceback.
    """


def require_extra(package: str, extra: str, user: str) -> None:
    """Refuse to start work if a package is missing; ``user`` is the feature that needs it.

    Raises:
        MissingExtraError: the package is not installed; the message says how to get it.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingExtraError(f"{user} needs {package}: pip install 'mmwave-loc[{extra}]'")
