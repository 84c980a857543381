"""A search for hyperparameters: what is free, within which range, and how often it is tried."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.sweeping.cell import HYPERPARAMETER, KINDS, Cell, kind_of, require_sound, values_of
from experiments.training.hyperparameters import MOST
from mmwave_env.lookup import choose, quoted

_KEYS = ("low", "high", "log")


@dataclass(frozen=True)
class Range:
    """From ``low`` to ``high``, both among them; whole numbers where both are.

    Attributes:
        log: every factor is as likely as another, not every difference.
    """

    low: float
    high: float
    log: bool = False


@dataclass(frozen=True)
class Search:
    """Trainings that differ in what is free.

    Attributes:
        fixed: values of the other axes.
        free: a range, or what to choose from, by axis.
        trials: how many trainings.
    """

    fixed: tuple[tuple[str, Any], ...]
    free: tuple[tuple[str, Range | tuple[Any, ...]], ...]
    trials: int

    @property
    def axes(self) -> list[str]:
        """Names of all axes."""
        return sorted(name for name, _ in (*self.fixed, *self.free))

    def cell(self, found: Mapping[str, Any]) -> Cell:
        """The training with these values of what is free."""
        return Cell("train", tuple(sorted((*self.fixed, *found.items()))))


def search_from(content: Mapping[str, Any]) -> Search:
    """The search of a file's tables.

    Raises:
        ValueError: naming the key, what was found and what was expected.
    """
    table = content["search"]
    if not isinstance(table, dict):
        raise ValueError(f"search: found {quoted(table)}, expected a table")
    if len(content) > 1:
        others = ", ".join(name for name in content if name != "search")
        raise ValueError(f"search: found {quoted(others)} beside it, expected it alone in its file")
    needed, known = KINDS["train"]
    ours = {"trials", HYPERPARAMETER[:-1]}
    for key in table:
        choose(dict.fromkeys(sorted(ours | known)), key, "search: key")
    for key in sorted((ours | needed) - set(table)):
        raise ValueError(f"search.{key}: found none, expected one")
    table = dict(table)
    trials, ranges = table.pop("trials"), table.pop(HYPERPARAMETER[:-1])
    if type(trials) is not int or trials < 1:
        raise ValueError(f"search.trials: found {quoted(trials)}, expected a whole number")
    if not isinstance(ranges, dict):
        raise ValueError(f"search.hyperparameters: found {quoted(ranges)}, expected ranges")
    fixed = {key: _only(key, values_of(key, value)) for key, value in table.items()}
    require_sound(Cell("train", tuple(sorted(fixed.items()))))
    free = {
        HYPERPARAMETER + name: _free(HYPERPARAMETER + name, value, fixed.get("algo", "ppo"))
        for name, value in ranges.items()
    }
    if all(isinstance(of, tuple) and len(of) == 1 for of in free.values()):
        raise ValueError(
            "search.hyperparameters: found one combination, expected a range or a list"
        )
    return Search(tuple(sorted(fixed.items())), tuple(sorted(free.items())), trials)


def _only(key: str, values: Sequence[Any]) -> Any:
    if len(values) > 1:
        raise ValueError(f"search.{key}: found {len(values)} values, expected one")
    return values[0]


def _free(axis: str, value: Any, algorithm: str) -> Range | tuple[Any, ...]:
    """What a hyperparameter may be: a table of a range, or a list of choices."""
    kind = kind_of(axis, algorithm)
    if isinstance(value, dict):
        return _range(axis, value, whole=kind is int)
    return tuple(values_of(axis, value))


def _range(axis: str, value: Mapping[str, Any], *, whole: bool) -> Range:
    for key in value:
        choose(dict.fromkeys(_KEYS), key, f"search.{axis}: key")
    low, high, log = (value.get(key, False) for key in _KEYS)
    expected = "whole numbers" if whole else "numbers"
    if any(type(end) is not int and (whole or type(end) is not float) for end in (low, high)):
        raise ValueError(f"search.{axis}: found {quoted(value)}, expected low and high, {expected}")
    if not 0 <= low < high < MOST:
        raise ValueError(
            f"search.{axis}: found {quoted(value)}, expected low below high, from 0 to {MOST:g}"
        )
    if type(log) is not bool or (log and low == 0):
        raise ValueError(
            f"search.{axis}: found {quoted(value)}, expected log true or false, and low above 0 "
            "where it is true"
        )
    return Range(low, high, log) if whole else Range(float(low), float(high), log)
