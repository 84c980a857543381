"""Checks of the arrays of a record, which is an episode or a track."""

from pathlib import Path
from typing import NoReturn

import numpy as np

from mmwave_env.numerics.numbers import Array


def refuse(record: str, field: str, value: object, expected: str) -> NoReturn:
    """Raise a ValueError about a field of a record; ``record`` is a name like "episode 'jam'"."""
    raise ValueError(f"{field} of {record}: found {value}, expected {expected}")


def refuse_in(file: Path, part: str, value: object, expected: str) -> NoReturn:
    """Raise a ValueError about a part of a file, such as a line or a named array."""
    raise ValueError(f"{file}: {part}: found {value}, expected {expected}")


def require_increasing(record: str, time_s: Array) -> None:
    """Refuse the times (T,) of epochs unless they increase."""
    if len(time_s) < 1 or not (np.diff(time_s) > 0.0).all():
        refuse(record, "time_s", "times that do not increase", "one or more increasing times")
