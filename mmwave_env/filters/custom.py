"""Trial runs of a user's algorithm before it is compiled: on floats, and on imitated SIMD lanes.

The compiler calls a function once, with numbers called lanes that stand for eight environments. A
trial run uses probes instead: numbers that refuse the same operations as lanes, but carry a value
that the function can't see. So a trial takes milliseconds, can name the line that asked for a
value, and detects a function that returns different values on lanes than on floats.
"""

import linecache
import math
import os
import sysconfig
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from traceback import walk_tb
from typing import Any, NamedTuple

from mmwave_env.filters.gating import Gate
from mmwave_env.filters.modes import ALGORITHMS, Mode
from mmwave_env.filters.update import Posterior
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Measurement, exact_rows
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Number
from mmwave_env.numerics.pytree import flatten, unflatten
from mmwave_env.numerics.tracer import FloatTracer, NoValueError, Tracer, value_of

_LANES_KNOW = (
    "a number on lanes supports only +, -, *, /, <, <=, >, >=, abs and the functions of "
    "mmwave_env.numerics.numbers"
)


_LIBRARIES = (
    f"{Path(__file__).parents[1]}{os.sep}",
    *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")),
    "<frozen ",
)


class AlgorithmError(TypeError):
    """An error in a user's algorithm; the message says where, why, and what to write instead."""


class Line(NamedTuple):
    """A line of a user's function; ``function`` is the function's name."""

    file: str
    number: int
    function: str

    def __str__(self) -> str:
        shown = f'  File "{self.file}", line {self.number}, in {self.function}'
        text = linecache.getline(self.file, self.number).strip()
        return f"{shown}\n    {text}" if text else shown


class _Trial(NamedTuple):
    """A trial epoch: the numbers of a prior x (7,), P (28,), a Measurement and a Gate."""

    x: list[Number]
    P: list[Number]
    measured: list[Any]  # the fields of a Measurement that precede ``layout``
    rows: list[Any]  # the fields that follow ``layout``; empty unless the layout is partial
    force: Number


def _trials(layout: Layout) -> Iterator[_Trial]:
    """Yield an epoch that measures everything, and one with an outlier and missing groups of rows.

    In a partial layout, in which single rows may be missing, also yield an epoch with only some of
    the rows and with the Doppler shift of the last anchor instead of the first.
    """
    hz_per_mps, scale = 93.4, [2.0, 1.5, 0.5, 1.0, 0.8, 0.2, 30.0]
    x = [12.0, -7.0, 1.5, 3.0, -2.0, 0.1, 20.0]
    if layout.clock:
        x, scale = [*x, 4.0], [*scale, 10.0]
    truth = [m + 0.5 * s for m, s in zip(x, scale, strict=True)]
    entries = [(i, j) for i in range(len(x)) for j in range(i + 1)]
    P = [scale[i] * scale[j] * (1.0 if i == j else 0.2) for i, j in entries]
    angles = [0.4 + 2.0 * math.pi * a / layout.anchors for a in range(layout.anchors)]
    anchors = [[60.0 * math.cos(a), 60.0 * math.sin(a), 10.0 + 3.0 * a] for a in angles]
    sigma = [1.0, 0.05, 0.05, 0.05] * layout.anchors + [30.0] + [0.5, 0.1] * layout.odometry
    exact = exact_rows(truth[:3], truth[3:6], anchors, hz_per_mps, layout)
    exact[layout.doppler] += truth[6]
    for a in range(layout.anchors):
        exact[4 * a] += sum(truth[7:])
    z = [h + 0.3 * s for h, s in zip(exact, sigma, strict=True)]
    variance = [s * s for s in sigma]

    def trial(z: list[float], measured: list[float], force: float, anchor: int) -> _Trial:
        visible = [max(measured[group]) for group in layout.groups]
        z = [value if m else 0.0 for m, value in zip(measured, z, strict=True)]
        shifted = [float(a == anchor) for a in range(layout.anchors)]
        rows = [measured, shifted] if layout.partial else []
        return _Trial(x, P, [anchors, hz_per_mps, z, variance, visible], rows, force)

    yield trial(z, [1.0] * layout.size, 0.0, 0)
    some = [float(g % 2 == 0) for g, k in enumerate(layout.widths) for _ in range(k)]
    yield trial([z[0] + 50.0, *z[1:]], some, 1.0, 0)
    if layout.partial:
        yield trial(z, [float(row % 3 > 0) for row in range(layout.size)], 0.0, layout.anchors - 1)


def check_algorithm(mode: Mode, layout: Layout, known_axes: tuple[int, ...]) -> None:
    """Try the algorithm of a mode, unless it is built in.

    Raises:
        AlgorithmError: the algorithm has the wrong arguments, modifies them, does not return a
            posterior, cannot run on lanes, or returns different values on lanes than on floats.
    """
    if mode.update not in ALGORITHMS.values():
        _check(mode, layout, known_axes)


@lru_cache(maxsize=64)
def _check(mode: Mode, layout: Layout, known_axes: tuple[int, ...]) -> None:
    for trial in _trials(layout):
        probes = unflatten(trial, map(FloatTracer, flatten(trial)))
        on_lanes = _run(mode, layout, known_axes, probes)
        on_floats = _run(mode, layout, known_axes, trial)
        problems = chain(
            _wrong_shapes(layout, on_floats),
            _wrong_shapes(layout, on_lanes),
            _unsound(trial, on_floats, on_lanes),
            _uses_missing_rows(mode, layout, known_axes, trial, on_floats),
        )
        if problem := next(problems, None):
            raise _error(mode, f"returned {problem}", begin_of(mode.update))


def _uses_missing_rows(
    mode: Mode, layout: Layout, known_axes: tuple[int, ...], trial: _Trial, result: Posterior
) -> Iterator[str]:
    """Yield faults: values of a result that depend on rows of z that were not measured."""
    if not trial.rows:
        return
    anchors, hz_per_mps, z, *rest = trial.measured
    other = [v + 0.3 * (1.0 - m) for v, m in zip(z, trial.rows[0], strict=True)]
    changed = trial._replace(measured=[anchors, hz_per_mps, other, *rest])
    moved = _run(mode, layout, known_axes, changed)
    values = [pair for field in result._asdict().items() for pair in _numbers(*field)]
    for (place, number), other in zip(values, flatten(moved), strict=True):
        if abs(number - other) > 1e-9 * (1.0 + abs(number)):
            yield (
                f"{place}: {number!r}, and {other!r} with other values in rows that are missing, "
                "expected the same: multiply by measurement.measured"
            )


def begin_of(function: Callable[..., Any]) -> Line | None:
    """Return the line on which a function begins; None if it was not written in Python."""
    while isinstance(function, partial):
        function = function.func
    code = getattr(function, "__code__", getattr(type(function).__call__, "__code__", None))
    return None if code is None else Line(code.co_filename, code.co_firstlineno, code.co_name)


def line_of(error: BaseException, function: Callable[..., Any]) -> Line | None:
    """Return the innermost line of the user's code in an error's traceback.

    The line is in the function's own file, or in a file that is not part of a library.
    """
    begin = begin_of(function)
    innermost = None
    for frame, number in walk_tb(error.__traceback__):
        file = frame.f_code.co_filename
        if (begin and file == begin.file) or not file.startswith(_LIBRARIES):
            innermost = Line(file, number, frame.f_code.co_name)
    return innermost


def _error(mode: Mode, problem: str, line: Line | None, advice: str = "") -> AlgorithmError:
    begin = begin_of(mode.update)
    name = repr(mode.update) if begin is None else begin.function
    parts = [f"algorithm {name} of mode {mode.name!r} {problem}", line and str(line), advice]
    # Gymnasium appends the environment's arguments to a message: let them begin on a new line.
    return AlgorithmError("\n".join(part for part in parts if part) + "\n")


def _run(mode: Mode, layout: Layout, known_axes: tuple[int, ...], trial: _Trial) -> Any:
    """Run the algorithm on an epoch and return its result."""
    x, P, measured, rows, force = unflatten(trial, iter(flatten(trial)))  # a copy
    fields: list[Any] = [*measured, layout, *rows] if rows else [*measured, layout, (), ()]
    measurement = Measurement._make(fields)
    gate = Gate(mode.gate, 0.0 if mode.recovery is None else force, mode.robust)
    arguments = x, unpack(P, zero=known_axes), measurement
    before = [flatten(argument) for argument in arguments]
    try:
        result = mode.update(*arguments, gate)
    except NoValueError as refusal:
        line = line_of(refusal, mode.update)
        raise _error(mode, "cannot run on lanes", line, str(refusal)) from None
    except Exception as error:
        advice = f"{type(error).__name__}: {error}"
        if isinstance(force, FloatTracer) and isinstance(error, TypeError | AttributeError):
            advice = f"{advice}\n{_LANES_KNOW}"
        # If the call itself failed, the traceback contains no line of the function.
        line = line_of(error, mode.update) or begin_of(mode.update)
        raise _error(mode, "failed in a trial run", line, advice) from error
    for name, argument, old in zip(("x", "P", "measurement"), arguments, before, strict=True):
        new = flatten(argument)
        if len(new) != len(old) or any(a is not b for a, b in zip(new, old, strict=True)):
            problem = f"changed its argument {name}, expected it to remain unchanged"
            raise _error(mode, problem, begin_of(mode.update))
    return result


def _wrong_shapes(layout: Layout, result: Any) -> Iterator[str]:
    """Yield the parts of a posterior that are missing, or have a wrong type or shape."""
    if not isinstance(result, Posterior):
        yield f"{_kind(result)}, expected a Posterior from mmwave_env.filters.update"
        return
    state, groups = [0.0] * layout.state_size, [0.0] * len(layout.groups)
    expected = Posterior(state, [state] * len(state), groups, groups, 0.0)
    for parts in zip(Posterior._fields, result, expected, strict=True):
        yield from _wrong_parts(*parts)


def _wrong_parts(name: str, value: Any, like: Any) -> Iterator[str]:
    """Yield the parts of a value that differ in type or shape from those of ``like``."""
    if isinstance(like, list):
        if not isinstance(value, list) or len(value) != len(like):
            parts = "rows" if isinstance(like[0], list) else "numbers"
            yield f"{name}: {_kind(value)}, expected a list of {len(like)} {parts}"
            return
        for i, (part, wanted) in enumerate(zip(value, like, strict=True)):
            yield from _wrong_parts(f"{name}[{i}]", part, wanted)
    elif isinstance(value, bool) or not isinstance(value, (float, int, Tracer)):
        hint = ": where(condition, 1.0, 0.0)" if isinstance(value, bool) else ""
        yield f"{name}: {_kind(value)}, expected a number{hint}"


def _numbers(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the name and the value of every number in a part of a posterior."""
    if isinstance(value, list):
        for i, part in enumerate(value):
            yield from _numbers(f"{name}[{i}]", part)
    else:
        yield name, value


def _kind(value: Any) -> str:
    kind = "None" if value is None else type(value).__name__
    return f"{kind} of {len(value)}" if isinstance(value, (list, tuple)) else kind


def _unsound(trial: _Trial, result: Posterior, on_lanes: Posterior) -> Iterator[str]:
    """Yield faults: infinity, NaN, asymmetry, use of missing groups, other values on lanes."""
    values = [pair for field in result._asdict().items() for pair in _numbers(*field)]
    for place, number in values:
        if not math.isfinite(number):
            yield f"{place}: {number}, expected a finite number"
    P = result.P
    for i in range(len(P)):
        for j in range(i):
            if abs(P[i][j] - P[j][i]) > 1e-9 * math.sqrt(abs(P[i][i] * P[j][j])):
                yield (
                    f"P[{i}][{j}]: {P[i][j]:g}, but P[{j}][{i}]: {P[j][i]:g}, expected a "
                    "symmetric matrix (mmwave_env.numerics.linalg.symmetric makes one)"
                )
    for g, visible in enumerate(trial.measured[-1]):
        if not visible and (result.nis[g] or result.accepted[g]):
            yield (
                f"nis[{g}]: {result.nis[g]:g} and accepted[{g}]: {result.accepted[g]:g} of a "
                "missing group, expected 0: multiply by measurement.visible"
            )
    for (place, number), other in zip(values, flatten(on_lanes), strict=True):
        if number != value_of(other):
            yield (
                f"{place}: {number!r} on floats and {value_of(other)!r} on lanes, expected the "
                "same: it must not depend on a number's type, random numbers or earlier calls"
            )
