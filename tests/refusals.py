"""Refusals of bad input: checked by the type of the error and the field that it names.

No test needs the words of a message, so that a sentence can be improved without touching tests.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


def fields_named(message: str) -> str:
    """Return the part of a message that names what is refused: all before "found"."""
    named, separator, _ = message.partition(" found ")
    return named if separator else message.partition(": ")[0]


@contextmanager
def refuses(*fields: object, error: type[Exception] = ValueError) -> Iterator[None]:
    """Check that the block is refused by an error of this type whose message names the fields.

    Args:
        fields: names of files, keys, columns, options or places ("line 3"), in any order.
        error: type of the error.
    """
    with pytest.raises(error) as caught:
        yield
    named = fields_named(str(caught.value))
    missing = [str(field) for field in fields if str(field) not in named]
    assert not missing, f"{caught.value!s}: names none of {missing}"
