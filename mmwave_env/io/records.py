"""Dataclasses that are stored in JSON files; the types of their fields define the valid values.

The types serve three purposes. A dataclass refuses values that do not fit (:func:`require_fields`).
Objects in JSON files are converted to dataclasses (:func:`read_object`). And the schemas of these
files, in mmwave_env/data/schemas, are generated from the types.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from mmwave_env.io.files import AnyPath, read_json
from mmwave_env.io.lookup import LONGEST, choose, is_name, quoted

T = TypeVar("T")


class Bound(NamedTuple):
    """Limits of a number."""

    expected: str  # the limits in words, for messages
    least: float | None = None  # smallest valid number; if None, valid numbers are > ``above``
    above: float = -math.inf
    most: float | None = None  # largest valid number; if None, valid numbers are < ``below``
    below: float = math.inf

    def holds(self, value: Any) -> Any:
        """Tell whether a number is valid or, for an array, which elements are valid; NaN is not."""
        low = value > self.above if self.least is None else value >= self.least
        return low & (value < self.below if self.most is None else value <= self.most)


def between(least: float, most: float, unit: str = "") -> Bound:
    """Return a bound with two limits."""
    return Bound(f"a number from {least:g} to {most:g} {unit}".rstrip(), least=least, most=most)


def counts(least: int, most: int) -> Bound:
    """Return a bound with two limits for an integer."""
    return Bound(f"an integer from {least} to {most}", least=least, most=most)


class Size(NamedTuple):
    """Limits of the length of a list."""

    least: int
    most: int

    @property
    def expected(self) -> str:
        """Return the limits in words."""
        return f"a list of length {self.least} to {self.most}"

    def holds(self, value: Any) -> bool:
        """Tell whether the length of a list is within the limits."""
        return self.least <= len(value) <= self.most


class Printable:
    """A rule for texts: they can be shown unchanged in tables and pictures."""

    expected = f"1 to {LONGEST} printable characters"
    holds = staticmethod(is_name)


FINITE = Bound("a finite number")
Probability = Annotated[float, Bound("a number in [0, 1]", least=0.0, most=1.0)]
Name = Annotated[str, Printable()]

_KINDS: dict[Any, tuple[type, str]] = {
    str: (str, "str"),
    bool: (bool, "bool"),
    int: (Integral, "int"),
    float: (Real, "a number"),
    type(None): (type(None), "None"),
}


@cache
def hints_of(kind: Any) -> Mapping[str, Any]:
    """Return the types of a dataclass's fields, with their annotations."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def _matches(hint: Any, value: Any) -> bool:
    """Tell whether a value fits the type of a field."""
    origin = get_origin(hint)
    inside = get_args(hint)
    if hint in _KINDS:
        matches = _is_kind(hint, value) and (hint is not float or FINITE.holds(value))
    elif origin is Annotated:
        base, limit = inside
        bounded = isinstance(limit, Bound)  # bounds may allow infinity, which no bare number may be
        matches = _is_kind(base, value) if bounded else _matches(base, value)
        matches = matches and (isinstance(limit, str) or limit.holds(value))
    elif origin is Literal:
        matches = value in inside
    elif origin in (Union, UnionType):
        matches = any(_matches(kind, value) for kind in inside)
    elif origin is dict:
        matches = isinstance(value, dict) and all(_matches(inside[1], v) for v in value.values())
    elif origin is tuple:
        each = inside[:1] * len(value) if _is_list(value) and inside[-1] is ... else inside
        matches = _is_list(value) and len(value) == len(each) and all(map(_matches, each, value))
    else:
        matches = callable(value) if origin else isinstance(value, hint)
    return bool(matches)


def _is_kind(hint: Any, value: Any) -> bool:
    """Tell whether a value is a text, a bool, a number or None, as a type in _KINDS asks."""
    return isinstance(value, _KINDS[hint][0]) and isinstance(value, bool) <= (hint is bool)


def _is_list(value: Any) -> bool:
    return isinstance(value, (tuple, list, np.ndarray))


def _describe(hint: Any) -> str:
    """Describe the valid values of a type, in words that can follow "expected" in a message."""
    origin = get_origin(hint)
    inside = get_args(hint)
    if hint in _KINDS:
        return _KINDS[hint][1]
    if origin is Annotated:
        return getattr(inside[1], "expected", inside[1])  # type: ignore[no-any-return]
    if origin is Literal:
        return f"one of {', '.join(map(str, inside))}"
    if origin in (Union, UnionType):
        return " or ".join(map(_describe, inside))
    if origin is tuple:
        each = [_describe(element) for element in inside if element is not ...]
        return f"a list, each element {each[0]}" if inside[-1] is ... else f"[{', '.join(each)}]"
    return "a function" if origin is Callable else "an object"


def require_fields(record: Any, of: str = "") -> None:
    """Refuse fields whose values do not fit their types; call this in ``__post_init__``.

    The message adds ``of``, such as " of radio 'lab'", to the field's name.

    Raises:
        ValueError: a value is invalid; the message names field, value and what was expected.
    """
    for name, hint in hints_of(type(record)).items():  # type: ignore[arg-type]
        require(name, getattr(record, name), hint, of)


class Record:
    """Base of dataclasses that refuse wrong values as they are made (:func:`require_fields`)."""

    # names of fields that are pairs [low, high], in which the first number must not be the larger
    ordered: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        require_fields(self)
        for name in self.ordered:
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(
                    f"{name}: found {(low, high)}, expected [low, high] with low <= high"
                )


def require(name: str, value: Any, hint: Any, of: str = "") -> None:
    """Refuse an argument that does not fit a type, which may be annotated with limits."""
    if _matches(hint, value):
        return
    bare = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    if get_origin(bare) is tuple and get_args(bare)[-1] is ... and _is_list(value):
        for i, element in enumerate(value):  # find the invalid element
            require(f"{name}[{i}]", element, get_args(bare)[0], of)
        raise ValueError(f"{name}{of}: found length {len(value)}, expected {_describe(hint)}")
    raise ValueError(f"{name}{of}: found {quoted(value)}, expected {_describe(hint)}")


def object_from(kind: type[T], content: Any, where: str = "") -> T:
    """Return a dataclass made from an object of a JSON file.

    Inner lists become tuples, and inner objects become dataclasses. ``where`` is a prefix for
    messages that says where the object is in the file, such as "walls[1].".

    Raises:
        ValueError: a key is unknown or missing, or the dataclass refuses a value.
    """
    if not isinstance(content, dict):
        place = f"{where[:-1]}: " if where else ""
        raise ValueError(f"{place}found {quoted(content)}, expected an object")
    hints = hints_of(kind)  # type: ignore[arg-type]
    for key in content:
        choose(hints, key, f"{where}key")
    for field in fields(kind):  # type: ignore[arg-type]
        if field.name not in content and field.default is field.default_factory is MISSING:
            beside = f" in addition to {', '.join(content)}" if content else ""
            raise ValueError(f"{where}{field.name}: found none, expected one{beside}")
    built = {key: _construct(hints[key], value, f"{where}{key}") for key, value in content.items()}
    try:
        return kind(**built)
    except ValueError as error:
        raise ValueError(f"{where}{error}") from error


def _construct(hint: Any, value: Any, where: str) -> Any:
    """Convert a value to the type of a field, if the type determines the conversion."""
    if value is None:
        return None
    if get_origin(hint) in (Annotated, Union, UnionType):
        return _construct(get_args(hint)[0], value, where)
    if get_origin(hint) is tuple and isinstance(value, list):
        inside = get_args(hint)[0]
        return tuple(
            _construct(inside, element, f"{where}[{i}]") for i, element in enumerate(value)
        )
    if get_origin(hint) is dict and isinstance(value, dict):
        inside = get_args(hint)[1]
        return {k: _construct(inside, v, f"{where}[{quoted(k)}]") for k, v in value.items()}
    if hint is float and type(value) is int:
        return float(value) if abs(value) < 1e300 else math.inf
    is_object = isinstance(hint, type) and is_dataclass(hint)
    return object_from(hint, value, f"{where}.") if is_object else value


def read_object(path: AnyPath, schema: str, make: Callable[[Any], T]) -> T:
    """Read an object from a JSON file and pass it to ``make``.

    The schema is "scene", "modes", "radio" or "mobility".

    Raises:
        ValueError: the file is invalid; the message names the file, the mistake and the schema.
        OSError: the file can't be read; FileNotFoundError if there is no such file.
    """
    described = f"mmwave_env/data/schemas/{schema}.schema.json"
    return read_json(Path(path), f"a {schema} file", make, described)
