"""Looking things up by name, with an error that lists the valid names."""

from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")


def choose(options: Mapping[str, T], name: str, what: str) -> T:
    """``options[name]``.

    Raises:
        ValueError: unknown name; the message lists the valid ones.
    """
    if not isinstance(name, str) or name not in options:
        raise ValueError(f"{what}: found {name!r}, expected one of {', '.join(options)}")
    return options[name]
