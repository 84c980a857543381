"""Mutants: one place of a function's body changed, and put to work where the function is used."""

import ast
import copy
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NamedTuple

from tests.paths import ROOT

FOLDER = ROOT / "mmwave_env" / "filters"
# The filters as equations; the others read files, check arguments or call another library.
EQUATIONS = (
    "belief", "gating", "imm", "linearization", "memory", "mode_result", "pipeline", "smoother",
    "update",
)  # fmt: skip

_OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
_NAMES = {"maximum": "minimum", "minimum": "maximum", "forward": "backward", "backward": "forward"}


class Mutant(NamedTuple):
    """A change of one expression, and how it reads before and after."""

    module: str
    function: tuple[str, ...]  # class, where it is in one, and name
    place: int  # number of the change among those of the function
    line: int
    before: str
    after: str

    def __str__(self) -> str:
        where = f"{self.module}.py:{self.line} {'.'.join(self.function)}"
        return f"{where}: `{self.before}` -> `{self.after}`"


def mutants() -> Iterator[Mutant]:
    """Every mutant of the equations."""
    for module in EQUATIONS:
        tree = _tree(module)
        for path, function in _functions(tree):
            for place in range(len(_places(function))):
                changed = copy.deepcopy(function)
                node, change = _places(changed)[place]
                before = ast.unparse(node)
                change()
                yield Mutant(module, path, place, node.lineno, before, ast.unparse(node))


def put_to_work(mutant: Mutant) -> None:
    """Change the function in this process, for all who imported it."""
    tree = _tree(mutant.module)
    node = dict(_functions(tree))[mutant.function]
    _places(node)[mutant.place][1]()
    code: Any = compile(ast.fix_missing_locations(tree), mutant.module, "exec", dont_inherit=True)
    for name in mutant.function:
        code = _inner(code, name)
    _found(mutant).__code__ = code


def _tree(module: str) -> ast.Module:
    return ast.parse(Path(FOLDER, f"{module}.py").read_text(encoding="utf-8"))


def _functions(tree: ast.Module) -> Iterator[tuple[tuple[str, ...], ast.FunctionDef]]:
    """Functions and methods; those within functions belong to these."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield (node.name,), node
        elif isinstance(node, ast.ClassDef):
            for inner in node.body:
                if isinstance(inner, ast.FunctionDef):
                    yield (node.name, inner.name), inner


def _places(function: ast.FunctionDef) -> list[tuple[Any, Callable[[], None]]]:
    """Expressions that can be changed, and what changes each; messages are none."""
    found: list[tuple[Any, Callable[[], None]]] = []
    waiting: list[ast.AST] = list(reversed(function.body))
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.Raise, ast.JoinedStr)):
            continue
        found += [(node, change) for change in _changes(node)]
        skipped = {id(one) for one in _notes(node)}
        waiting += [one for one in ast.iter_child_nodes(node) if id(one) not in skipped]
    return found


def _notes(node: ast.AST) -> list[ast.AST]:
    """Annotations, which nobody runs."""
    return [one for name in ("annotation", "returns") if (one := getattr(node, name, None))]


def _changes(node: Any) -> list[Callable[[], None]]:
    """What can be made of an expression."""
    changes: list[Callable[[], None]] = []

    def to(name: str, value: Any) -> None:
        changes.append(lambda: setattr(node, name, value))

    if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in _OPERATORS:
        to("op", _OPERATORS[type(node.op)]())
    elif isinstance(node, ast.Compare):
        to("ops", [_OPERATORS[type(op)]() for op in node.ops])
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        to("value", node.value + 1 if type(node.value) is int else 1.1 * node.value or 0.1)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not)):
        to("op", ast.UAdd())
    elif isinstance(node, ast.Name) and node.id in _NAMES:
        to("id", _NAMES[node.id])
    elif isinstance(node, (ast.If, ast.IfExp)) and not isinstance(node.test, ast.Compare):
        to("test", ast.UnaryOp(ast.Not(), node.test))
    return changes


def _inner(code: CodeType, name: str) -> CodeType:
    """The code of a class or function within another's."""
    inner = [one for one in code.co_consts if isinstance(one, CodeType) and one.co_name == name]
    return inner[0]


def _found(mutant: Mutant) -> Any:
    """The function that runs."""
    holder: ModuleType | type = importlib.import_module(f"mmwave_env.filters.{mutant.module}")
    for name in mutant.function:
        holder = vars(holder)[name]
    return holder.fget if isinstance(holder, property) else holder
