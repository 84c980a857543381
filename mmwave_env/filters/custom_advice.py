"""Which line of a user's function went wrong, and what to write there instead."""

import ast
import linecache
import os
import sysconfig
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from traceback import walk_tb
from typing import Any, NamedTuple

from mmwave_env.numerics.tracer import REFUSALS

_LIBRARIES = (
    f"{Path(__file__).parents[1]}{os.sep}",
    *(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")),
    "<frozen ",
)
_PAIRWISE = "mmwave_env.numerics.numbers.{}, two numbers at a time"
_SAME_NAME = {  # functions of math and numpy that mmwave_env.numerics.numbers has
    **dict.fromkeys(("sqrt", "log", "exp", "atan2"), ""),
    "arctan2": "atan2",
}
_ELEMENTARY = {
    **{name: f"mmwave_env.numerics.numbers.{ours or name}" for name, ours in _SAME_NAME.items()},
    **dict.fromkeys(("fabs", "abs", "absolute"), "abs(a)"),
    "hypot": "sqrt(a * a + b * b), with mmwave_env.numerics.numbers.sqrt",
    "pow": REFUSALS["power"][1],
    "square": "a * a",
}
_ALGEBRA = "cholesky, forward, backward and dot of mmwave_env.numerics.linalg"
INSTEAD = {  # by what was asked for: a word of the line, and what to write in its place
    "truth": {
        "while": "a for loop over a constant range, with where(condition, new, old) in it",
        "if": "where(condition, a, b)",
        "assert": "nothing: a function on lanes cannot check values",
        "and": "(a > 0.0) & (b > 0.0)",
        "or": "(a > 0.0) | (b > 0.0)",
        "not": "the opposite comparison, or where(condition, b, a)",
        "a < b < c": "(a < b) & (b < c)",
        "max": _PAIRWISE.format("maximum(a, b)"),
        "min": _PAIRWISE.format("minimum(a, b)"),
        "sorted": "minimum(a, b) and maximum(a, b) of pairs, in an order that is fixed",
        "sort": "minimum(a, b) and maximum(a, b) of pairs, in an order that is fixed",
        "any": "conditions joined by |",
        "all": "conditions joined by &",
        "bool": "the condition itself, for where(condition, a, b)",
    },
    "value": {"float": "the number itself", **_ELEMENTARY},
    "integer": {
        **dict.fromkeys(("int", "round", "floor", "ceil", "trunc"), "the number, unrounded"),
        "range": "range(n) of a constant n, and where(i < count, new, old) for the rest",
        "[]": "where(condition, a[0], a[1]) for each of the entries",
    },
    "numpy": {
        **dict.fromkeys(("array", "asarray", "stack", "zeros", "vstack"), "a list of numbers"),
        **_ELEMENTARY,
        **dict.fromkeys(("where", "maximum", "minimum", "clip"), "mmwave_env.numerics.numbers's"),
        **dict.fromkeys(("dot", "inner", "vdot", "matmul"), "mmwave_env.numerics.linalg.dot"),
        **dict.fromkeys(("inv", "solve", "cholesky", "det", "eigh", "pinv"), _ALGEBRA),
        **dict.fromkeys(("sum", "max", "min"), "a loop over a list"),
        **dict.fromkeys(("float64", "float32"), "a plain float"),
    },
}


class Line(NamedTuple):
    """A line of a user's function; ``function`` is its name."""

    file: str
    number: int
    function: str

    def __str__(self) -> str:
        shown = f'  File "{self.file}", line {self.number}, in {self.function}'
        text = linecache.getline(self.file, self.number).strip()
        return f"{shown}\n    {text}" if text else shown

    def words(self) -> Iterator[str]:
        """What stands on the line: names of functions called, and words of Python itself."""
        try:
            tree = ast.parse("".join(linecache.getlines(self.file)))
        except SyntaxError:  # no Python file: a page of documentation, say
            return
        for node in ast.walk(tree):
            if isinstance(node, ast.expr) and _covers(node, node, self.number):
                yield from _words_of(node)
            elif isinstance(node, _BRANCHES) and _covers(node, node.test, self.number):
                yield type(node).__name__.lower()


_BRANCHES = (ast.If, ast.While, ast.Assert)
_WORDS = {ast.And: "and", ast.Or: "or", ast.Not: "not"}


def _covers(first: Any, last: Any, line: int) -> bool:
    return bool(first.lineno <= line <= last.end_lineno)


def _words_of(node: ast.expr) -> Iterator[str]:
    match node:
        case ast.Call():
            yield ast.unparse(node.func)
        case ast.IfExp():
            yield "if"
        case ast.ListComp(generators=loops) | ast.GeneratorExp(generators=loops):
            if any(loop.ifs for loop in loops):
                yield "if"
        case ast.BoolOp(op=op) | ast.UnaryOp(op=op):
            yield _WORDS.get(type(op), "")
        case ast.Compare(ops=[_, _, *_]):
            yield "a < b < c"
        case ast.Subscript():
            yield "[]"


def begin_of(function: Callable[..., Any]) -> Line | None:
    """The line on which a function begins; None of one that was not written in Python."""
    while isinstance(function, partial):
        function = function.func
    code = getattr(function, "__code__", getattr(type(function).__call__, "__code__", None))
    return None if code is None else Line(code.co_filename, code.co_firstlineno, code.co_name)


def line_of(error: BaseException, function: Callable[..., Any]) -> Line | None:
    """The innermost line of the user's in an error's traceback.

    It is in the function's own file, or in another that is no part of a library.
    """
    begin = begin_of(function)
    found = None
    for frame, number in walk_tb(error.__traceback__):
        file = frame.f_code.co_filename
        if (begin and file == begin.file) or not file.startswith(_LIBRARIES):
            found = Line(file, number, frame.f_code.co_name)
    return found


def instead(asked: str, line: Line | None) -> str:
    """What to write in place of what asked for a value, a line for each word that may have."""
    known = INSTEAD.get(asked, {})
    words = {} if line is None else {word.split(".")[-1]: word for word in line.words()}
    found = [f"  instead of {words[name]} write {known[name]}" for name in known if name in words]
    return "\n".join(found) or f"  write {REFUSALS[asked][1]} instead"
