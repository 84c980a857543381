"""A check that bad input raises an error of the right type whose message names the right field.

The check ignores all other words, so that messages can be improved without changing tests.
"""

from contextlib import contextmanager

import pytest


def fields_named(message):
    """Return the field that a message names: the text before " found " or else before a colon."""
    named, separator, _ = message.partition(" found ")
    return named if separator else message.partition(": ")[0]


@contextmanager
def refuses(*fields, error=ValueError):
    """Check that the block raises an error of this type whose message names the fields.

    Args:
        fields: files, keys, columns, options or places (such as "line 3"), in any order.
        error: type of the error.
    """
    with pytest.raises(error) as caught:
        yield
    named = fields_named(str(caught.value))
    missing = [str(field) for field in fields if str(field) not in named]
    assert not missing, f"{caught.value!s}: does not name {missing}"
