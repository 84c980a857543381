"""Parser of a command's options: tyro reads them from the dataclass that declares them.

The docstring of the dataclass is the help of the command; its last paragraph is an example. The
string below a field is the help of the option. A mistake is reported in one line.
"""

import ast
import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from io import StringIO
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

T = TypeVar("T")
WIDTH = 80  # maximum width of help texts, columns
UNLIMITED = 10_000  # number of columns that no line of tyro's messages reaches
RULE = re.compile(r"^ +-+ *$", re.MULTILINE)  # line between the parts of tyro's messages


@dataclass(kw_only=True)
class Everywhere:
    """Options of every command, handled by the main program and not by the command."""

    quiet: bool = False
    """show neither tables nor progress, only warnings and errors"""
    debug: bool = False
    """if something fails, show where in the program (a traceback)"""


def parse(arguments: type[T], words: Sequence[str], program: str) -> T:
    """Parse words into an instance of a dataclass of options; errors name the ``program``.

    Raises:
        SystemExit: with 0 after showing help, with 2 after one line about a wrong option.
    """
    import tyro

    read = described(arguments)
    config = (tyro.conf.DisallowNone,)
    width = min(WIDTH, shutil.get_terminal_size().columns)
    box = StringIO()
    helped = not {"-h", "--help"}.isdisjoint(words)
    if helped:
        print(_wrapped(inspect.getdoc(arguments) or "", width), end="\n\n")
    try:
        with (
            _columns(width if helped else UNLIMITED),
            redirect_stdout(sys.stdout if helped else box),  # help needs a stream with an encoding
            redirect_stderr(box),
        ):
            parsed = tyro.cli(read, prog=program, description="", args=words, config=config)
    except SystemExit as end:
        if end.code:
            from mmwave_env.io.lookup import printable

            print(f"{program}: {printable(_message(box.getvalue()))}", file=sys.stderr)
        raise
    own = [option.name for option in fields(arguments)]  # type: ignore[arg-type]
    return arguments(**{name: getattr(parsed, name) for name in own})


def described(arguments: type[Any]) -> type[Any]:
    """Return the options and their help as a dataclass for tyro, with inherited options last."""
    from tyro.conf import FlagCreatePairsOff, arg

    kinds = get_type_hints(Everywhere) | get_type_hints(arguments, include_extras=True)
    defaults = {option.name: option.default for option in (*fields(Everywhere), *fields(arguments))}
    made = []
    for declares in (*arguments.__mro__[:-1], Everywhere):
        for name, text in _texts(declares).items():
            kind = kinds[name]
            default = defaults[name]
            nothing = default is None or default is False or default == ()
            hint = "(required)" if default is MISSING else "" if nothing else None
            shown = name.upper() + ("..." if "tuple" in str(kind) else "")
            shown = shown if default is MISSING else f"[{shown}]"
            # If hint or metavar is None, tyro writes its own text.
            metavar = shown if is_positional(kind) else None
            kind = Annotated[kind, arg(help=text, help_behavior_hint=hint, metavar=metavar)]
            if default is False:  # this marker suppresses --no-NAME
                kind = Annotated[kind, FlagCreatePairsOff]
            made.append((name, kind, field(default=default)))
    return make_dataclass(arguments.__name__, made, kw_only=True)


def _texts(declares: type[Any]) -> dict[str, str]:
    """Return the text below every field that a class itself declares."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(declares))).body
    assert isinstance(tree, ast.ClassDef)
    texts = {}
    for line, text in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            assert isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
            texts[line.target.id] = " ".join(str(text.value.value).split())
    return texts


def is_positional(kind: Any) -> bool:
    """Return whether an annotation says that the value is given without the option's name."""
    from tyro.conf import Positional

    return Positional in get_args(kind)


def _wrapped(text: str, width: int) -> str:
    """Wrap all paragraphs but the last, which is an example with one command on each line."""
    *about, example = text.split("\n\n")
    wrapped = ["\n".join(textwrap.wrap(part, width, break_on_hyphens=False)) for part in about]
    return "\n\n".join([*wrapped, "example:\n" + textwrap.indent(example, "  ")])


@contextmanager
def _columns(count: int) -> Iterator[None]:
    """Make the terminal appear to have ``count`` columns within the block."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(count)
    try:
        yield
    finally:
        os.environ.pop("COLUMNS")
        if before is not None:
            os.environ["COLUMNS"] = before


def _message(box: str) -> str:
    """Return, in one line, tyro's message about a mistake and the option that tyro suggests."""
    _, message, suggestion, *_ = (" ".join(part.split()) for part in RULE.split(box))
    close = re.match(r"Perhaps you meant: (\S+)", suggestion)
    end = f"; did you mean {close[1]}?" if close else "; --help lists all options"
    message = re.sub(r"^Missing from .*?: ", "required: ", message.partition(" Got errors")[0])
    return message.rstrip(".") + end
