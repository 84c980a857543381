"""Checks of the arrays of a record, which is an episode or a track."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from mmwave_env.numerics.numbers import Array


def refuse(record: str, field: str, value: object, expected: str) -> NoReturn:
    """Raise a ValueError about a field of a record; ``record`` is a name like "episode 'jam'"."""
    raise ValueError(f"{field} of {record}: found {value}, expected {expected}")


def refuse_in(file: Path, part: str, value: object, expected: str) -> NoReturn:
    """Raise a ValueError about a part of a file, such as a line or a named array."""
    raise ValueError(f"{file}: {part}: found {value}, expected {expected}")


def require_epochs(record: str, epochs: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse arrays of wrong shapes, and times that do not increase.

    ``epochs`` has the attribute ``time_s`` and all attributes named in ``shapes``: arrays or None.
    """
    for field, shape in shapes.items():
        value = getattr(epochs, field)
        if value is not None and value.shape != shape:
            refuse(record, field, f"shape {value.shape}", f"shape {shape}")
    require_increasing(record, epochs.time_s)


def require_increasing(record: str, time_s: Array) -> None:
    """Refuse the times (T,) of epochs unless they increase."""
    if len(time_s) < 1 or not (np.diff(time_s) > 0.0).all():
        refuse(record, "time_s", "times that do not increase", "one or more increasing times")


def require_finite(record: str, epochs: Any, fields: Iterable[str]) -> None:
    """Refuse NaN and infinity in these fields of ``epochs``; see :func:`require_epochs`."""
    for field in fields:
        value = getattr(epochs, field)
        if value is not None and not np.isfinite(value).all():
            refuse(record, field, "NaN or infinity", "finite numbers")
