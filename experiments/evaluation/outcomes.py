"""What a training came to, as it wrote it."""

import math
from collections.abc import Mapping
from typing import Any


def is_number(value: Any) -> bool:
    """Whether it is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def require_interval(key: str, found: Any) -> None:
    """Refuse what is no mean with its interval."""
    if isinstance(found, dict) and is_number(found.get("mean")) and "ci95" in found:
        ends = found["ci95"]
        if ends is None or (len(ends) == 2 and all(map(is_number, ends))):
            return
    raise ValueError(f"{key}: found {found!r:.60}, expected a mean and its ci95")


def require_outcome(found: Mapping[str, Any]) -> None:
    """Refuse what is no outcome of a training.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: what is wrong in it.
    """
    best, beat = found["best"], found.get("beat_rule")
    numbers = [found["seed"], best["reward"], best["timesteps"]]
    if beat:
        numbers += [beat["timesteps"], beat["seconds"]]
    for value in numbers:
        if not is_number(value):
            raise ValueError(f"found {value!r}, expected a number")
    for key, gain in best.items():
        if key.startswith("minus "):
            require_interval(key, gain)
