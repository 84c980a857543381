"""Parser of a command's options: tyro reads them from the dataclass that declares them.

The docstring of a dataclass is the help, and its last paragraph an example. The text below a field
is the help of its option. A mistake is reported in one line.
"""

import ast
import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from difflib import get_close_matches
from io import StringIO
from itertools import takewhile
from types import UnionType
from typing import Annotated, Any, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

from experiments.console.removed import OPTIONS

T = TypeVar("T")
WIDTH = 80  # widest help, columns
UNLIMITED = 10_000  # columns, so that no word of a message is cut
NUMBERS = {int: "a whole number", float: "a number"}


@dataclass(kw_only=True)
class Everywhere:
    """Options of every command, which the command line itself handles."""

    quiet: bool = False
    """show neither tables nor progress, only warnings and errors"""
    debug: bool = False
    """where something fails, show where in the program"""


def parse(arguments: type[T], words: Sequence[str], program: str) -> T:
    """Parse words into an instance of a dataclass of options.

    Args:
        arguments: a dataclass with a text below every field.
        words: command line after the name of the command.
        program: name of the command, for help and errors.

    Raises:
        SystemExit: with 0 after showing help, with 2 after one line about a wrong option.
    """
    import tyro

    read, kinds = described(arguments), get_type_hints(arguments)
    width = min(WIDTH, shutil.get_terminal_size().columns)
    options: dict[str, Any] = {
        "prog": program, "args": words, "config": (tyro.conf.DisallowNone,), "description": "",
    }  # fmt: skip
    if not {"-h", "--help"}.isdisjoint(words):
        print(_folded(inspect.getdoc(arguments) or "", width), end="\n\n")
        with _columns(width):
            tyro.cli(read, **options)
    _refuse_unknown(program, words, read)
    said = StringIO()
    try:
        with _columns(UNLIMITED), redirect_stdout(StringIO()), redirect_stderr(said):
            found = tyro.cli(read, **options)
    except SystemExit:
        _refuse(program, _message(said.getvalue(), kinds))
    for one in fields(read):
        if one.default is MISSING and getattr(found, one.name) == ():  # tyro accepts no value
            _refuse(program, f"required: {one.name}, one or more")
    everywhere = {one.name for one in fields(Everywhere)}
    return arguments(**{k: value for k, value in vars(found).items() if k not in everywhere})


def described(arguments: type[Any]) -> type[Any]:
    """Return a dataclass for tyro: own options before inherited options, each with its help."""
    from tyro.conf import FlagCreatePairsOff, arg

    kinds = get_type_hints(Everywhere) | get_type_hints(arguments, include_extras=True)
    known = {one.name: one for one in (*fields(Everywhere), *fields(arguments))}
    made = []
    for declares in (*arguments.__mro__[:-1], Everywhere):
        for name, text in _texts(declares).items():
            kind, default = kinds[name], known[name].default
            nothing = default is None or default is False or default == ()
            required = default is MISSING
            usual = "(required)" if required else "" if nothing else None  # None: tyro's own hint
            metavar = _metavar(name, kind, required)
            kind = Annotated[kind, arg(help=text, help_behavior_hint=usual, metavar=metavar)]
            if default is False:  # suppresses --no-NAME
                kind = Annotated[kind, FlagCreatePairsOff]
            made.append((name, kind, field(default=default)))
    return make_dataclass(arguments.__name__, made, kw_only=True)


def _texts(declares: type[Any]) -> dict[str, str]:
    """Return the text below every field that a class declares itself."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(declares))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for one, text in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
            assert isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
            found[one.target.id] = " ".join(str(text.value.value).split())
    return found


def _metavar(name: str, kind: Any, required: bool) -> str | None:
    """Return the placeholder of a value in help; None where tyro's own is right."""
    several = "..." if get_origin(_plain(kind)) is tuple else ""
    if is_positional(kind):
        shown = name.upper() + several
        return shown if required else f"[{shown}]"
    return f"{get_args(_plain(kind))[0].__name__.upper()}{several}" if several else None


def is_positional(kind: Any) -> bool:
    """Tell whether an annotation says that the value is given without the name of its option."""
    from tyro.conf import Positional

    return Positional in get_args(kind)


def _plain(kind: Any) -> Any:
    """Return an annotation without its metadata and without None."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (one for one in get_args(kind) if one is not type(None))
    return kind


def _folded(text: str, width: int) -> str:
    """Fold paragraphs at a width; the last paragraph is an example with one command a line."""
    *about, example = text.split("\n\n")
    folded = ["\n".join(textwrap.wrap(part, width, break_on_hyphens=False)) for part in about]
    return "\n\n".join([*folded, "example:\n" + textwrap.indent(example, "  ")])


@contextmanager
def _columns(count: int) -> Iterator[None]:
    """Pretend in the block that the terminal has ``count`` columns."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(count)
    try:
        yield
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before


# --- mistakes


def _refuse_unknown(program: str, words: Sequence[str], read: type[Any]) -> None:
    """Refuse the first word that looks like an option but is not known."""
    kinds = get_type_hints(read, include_extras=True)
    aliases = [one for kind in kinds.values() for m in get_args(kind) for one in _aliases(m)]
    names = [f"--{name.replace('_', '-')}" for name in kinds]
    negated = [f"--no-{one.name.replace('_', '-')}" for one in fields(read) if one.default is True]
    known = ["--help", *names, *negated, *aliases]
    given = [word.partition("=")[0] for word in words if word.startswith("--")]
    for word, option in zip((w for w in words if w.startswith("--")), given, strict=True):
        if given.count(option) > 1:
            _refuse(program, f"{option}: found it {given.count(option)} times, expected once")
        if option in known:
            continue
        if option in OPTIONS:
            _refuse(program, f"{option} is gone: {OPTIONS[option]}")
        close = get_close_matches(option, known, 1)
        hint = f"did you mean {close[0]}? F" if close else "f"
        end = "" if close else "; --help lists all"
        _refuse(program, f"{hint}ound {word!r}, expected an option of this command{end}")


def _aliases(said: Any) -> Sequence[str]:
    return getattr(said, "aliases", None) or ()


def _message(box: str, kinds: Mapping[str, Any]) -> str:
    """Return tyro's message about a mistake, without the box and the hints below it."""
    lines = takewhile(lambda line: set(line.strip()) != {"-"}, box.splitlines()[2:])
    text = " ".join(" ".join(lines).split())
    if choice := re.match(r"invalid choice '(.*?)' for argument '(?:--)?(.*?)'", text):
        value, name = choice.groups()
        from mmwave_env.io.lookup import unknown

        return unknown(name, value, get_args(_plain(kinds[name.replace("-", "_")])))
    if number := re.match(r"Error parsing (?:--)?([\w-]+): .*?('.*?')", text):
        kind = _plain(kinds[number[1].lower().replace("-", "_")])
        kind = get_args(kind)[0] if get_origin(kind) is tuple else kind
        return f"{number[1]}: found {number[2]}, expected {NUMBERS[kind]}"
    if missing := re.match("Missing value for argument '--(.*?)'", text):
        return f"{missing[1]}: found no value, expected one"
    if text.startswith("Unrecognized options"):
        text += "; an option takes one value, unless --help shows dots after it"
    return re.sub(r"^Missing from .*?: ", "required: ", text)


def _refuse(program: str, message: str) -> NoReturn:
    from mmwave_env.io.lookup import printable

    print(f"{program}: {printable(message)}", file=sys.stderr)
    sys.exit(2)
