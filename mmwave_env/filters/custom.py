"""Trial runs of a user's function (a filter's algorithm or a reward) before it is compiled.

The compiler calls a function once, with *lanes*: numbers that each stand for eight environments,
and so have no single value. A trial run calls the function with other numbers, which refuse the
same operations as lanes. A trial run takes milliseconds, because nothing is compiled. If it fails,
the error names the line that needed a value. Trial runs do not notice wrong values in results.
"""

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from traceback import FrameSummary, format_list, walk_tb
from typing import Any

from mmwave_env.filters.gating import Gate
from mmwave_env.filters.modes import ALGORITHMS, Mode
from mmwave_env.filters.update import Posterior
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Measurement, blank_site, exact_rows
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Matrix, Numbers
from mmwave_env.numerics.pytree import flatten
from mmwave_env.numerics.tape import Tracer, TracerCondition, taped

_LANES_KNOW = (
    "a number on lanes supports only +, -, *, /, <, <=, >, >=, abs and the functions of "
    "mmwave_env.numerics.numbers (docs/own-filters.md, Rules)"
)
# An own algorithm's log-likelihood must fall by at least this share of what the EKF's falls by, and
# must not be farther from it.
LEAST_FALL = 0.05
LARGEST_DIFFERENCE = 100.0

Function = Callable[..., Any]


class AlgorithmError(TypeError):
    """An error in a user's algorithm; the message names the line, the reason and a remedy."""


def name_of(function: Function) -> str:
    """Return the name of a function, or of the class of an object that can be called."""
    while isinstance(function, partial):
        function = function.func
    return str(getattr(function, "__name__", type(function).__name__))


def _line_of(function: Function, error: BaseException | None) -> FrameSummary | None:
    """Return the innermost line, in an error's traceback, of the file of the user's function.

    Without an error, return the line on which the function begins; None if it was not written in
    Python.
    """
    while isinstance(function, partial):
        function = function.func
    code = getattr(function, "__code__", getattr(type(function).__call__, "__code__", None))
    line = code and FrameSummary(code.co_filename, code.co_firstlineno, code.co_name)
    for frame, number in walk_tb(error.__traceback__ if error else None):
        if code and frame.f_code.co_filename == code.co_filename:
            line = FrameSummary(code.co_filename, number, frame.f_code.co_name)
    return line


def complaint(
    subject: str,
    function: Function,
    problem: str,
    error: BaseException | None = None,
    advice: str = "",
) -> str:
    """Return the error message about a user's function, with a line of the user's code.

    The message begins with ``subject``. The line is the innermost line of the user's code in the
    traceback of ``error``; without an error, it is the line on which the function begins.
    """
    line = _line_of(function, error)
    shown = [*format_list([line] if line else []), f"{advice}\n" if advice else ""]
    # The message ends with a line break because Gymnasium appends the environment's arguments.
    return f"{subject} {problem}\n" + "".join(shown)


def try_out(
    function: Function, arguments: tuple[Any, ...], subject: str, kind: type[Exception]
) -> Any:
    """Call a user's function with arguments whose numbers hide their values; return the result.

    Raises:
        Exception: the function cannot run; ``kind`` is the type of the exception.
    """
    try:
        return function(*arguments)
    except Exception as error:
        advice = f"{type(error).__name__}: {error}"
        if isinstance(error, TypeError | AttributeError):
            advice = f"{advice}\n{_LANES_KNOW}"
        problem = "failed in a trial run"
        raise kind(complaint(subject, function, problem, error, advice)) from error


@lru_cache(maxsize=64)
def check_algorithm(mode: Mode, layout: Layout, known_axes: tuple[int, ...]) -> None:
    """Call the algorithm of a mode in a trial run, unless the algorithm is built in.

    Raises:
        AlgorithmError: the algorithm cannot run on lanes, takes the wrong arguments, modifies
            its arguments, does not return a posterior of numbers, or returns a
            log-likelihood that does not fall as innovations grow.
    """
    algorithm = mode.update
    if algorithm in ALGORITHMS.values():
        return
    subject = f"algorithm {name_of(algorithm)} of mode {mode.name!r}"
    arguments = _arguments(mode, layout, known_axes, 0.0, hidden=True)
    before = [flatten(argument) for argument in arguments]
    result = try_out(algorithm, arguments, subject, AlgorithmError)
    names = "x", "P", "measurement", "gate"
    for name, argument, old in zip(names, arguments, before, strict=True):
        new = flatten(argument)
        if len(new) != len(old) or any(a is not b for a, b in zip(new, old, strict=True)):
            problem = f"changed its argument {name}, expected it to remain unchanged"
            raise AlgorithmError(complaint(subject, algorithm, problem))
    if problem := next(_wrong_shapes(result, ALGORITHMS["ekf"](*arguments)), ""):
        raise AlgorithmError(complaint(subject, algorithm, f"returned {problem}"))
    likelihoods = []
    usual = []
    for sigmas in (0.0, 1.0):
        example = _arguments(mode, layout, known_axes, sigmas)
        likelihoods.append(try_out(algorithm, example, subject, AlgorithmError).log_likelihood)
        usual.append(ALGORITHMS["ekf"](*example).log_likelihood)
    falls = likelihoods[0] - likelihoods[1] >= LEAST_FALL * (usual[0] - usual[1])
    if not (falls and abs(likelihoods[0] - usual[0]) < LARGEST_DIFFERENCE):
        problem = (
            f"returned log_likelihood {likelihoods[0]:g} without any innovation and "
            f"{likelihoods[1]:g} with innovations of one standard deviation, expected about "
            f"{usual[0]:g} and {usual[1]:g}, as of the EKF; an IMM would trust the mode however "
            "wrong it is"
        )
        raise AlgorithmError(complaint(subject, algorithm, problem))


def _arguments(
    mode: Mode, layout: Layout, known_axes: tuple[int, ...], sigmas: float, hidden: bool = False
) -> tuple[Numbers, Matrix, Measurement, Gate]:
    """Return arguments for the algorithm of a mode: x (7,), P (7, 7), a measurement, a gate.

    Measured values are ``sigmas`` deviations off their prediction. The prior is almost exact, so
    the innovation's standard deviation is that of the noise. Numbers may hide their values.
    """
    n = layout.state_size
    anchors = blank_site(layout).anchors
    x = [40.0, 15.0, 1.5, 1.0, 0.5, 0.0, 0.0, 0.0][:n]
    P = [1e-8 * (i == j) for i in range(n) for j in range(i + 1)]
    z = [row + 0.1 * sigmas for row in exact_rows(x, x[3:6], anchors, 1.0, layout)]
    visible = [1.0] * len(layout.groups)
    first = [1.0] + [0.0] * (layout.anchors - 1)
    partial_rows = [[1.0] * layout.size, first] if layout.partial else [(), ()]
    rows = [z, [0.01] * layout.size, visible]
    numbers: Any = [x, P, 0.0, [anchors, 1.0, *rows], partial_rows]
    x, P, force, measured, present = taped(numbers, []) if hidden else numbers
    measurement = Measurement._make([*measured, layout, *present])
    gate = Gate(mode.gate, 0.0 if mode.recovery is None else force, mode.robust)
    return x, unpack(P, zero=known_axes), measurement, gate


def _wrong_shapes(result: Any, like: Posterior) -> Iterator[str]:
    """Describe each part of a posterior that is missing, or has a wrong type or shape."""
    if not isinstance(result, Posterior):
        yield f"{_kind(result)}, expected a Posterior from mmwave_env.filters.update"
        return
    for parts in zip(Posterior._fields, result, like, strict=True):
        yield from wrong_parts(*parts)


def wrong_parts(name: str, value: Any, like: Any) -> Iterator[str]:
    """Describe each part of a value whose type or shape differs from the same part of ``like``."""
    if isinstance(like, list):
        if not isinstance(value, list) or len(value) != len(like):
            parts = "rows" if isinstance(like[0], list) else "numbers"
            yield f"{name}: {_kind(value)}, expected a list of {len(like)} {parts}"
            return
        for i, (part, wanted) in enumerate(zip(value, like, strict=True)):
            yield from wrong_parts(f"{name}[{i}]", part, wanted)
    elif isinstance(value, bool | TracerCondition):
        yield f"{name}: a condition, expected a number; convert it with where(condition, 1.0, 0.0)"
    elif not isinstance(value, float | int | Tracer):
        yield f"{name}: {_kind(value)}, expected a number"


def _kind(value: Any) -> str:
    if value is None or isinstance(value, Tracer):
        return "None" if value is None else "a number"
    kind = type(value).__name__
    return f"{kind} of {len(value)}" if isinstance(value, list | tuple) else kind
