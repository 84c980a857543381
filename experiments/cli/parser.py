"""The options of a command, read from the dataclass that declares them.

A field is an option, its annotation the kind of value, and the text below it the help. The
docstring says what the command does; its last paragraph is an example. Options that a dataclass
inherits are a group of their own, under the docstring they come from.
"""

import argparse
import ast
import inspect
import re
import textwrap
import types
from collections.abc import Callable, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

from mmwave_env.lookup import did_you_mean, printable, unknown

T = TypeVar("T")

EVERYWHERE = {  # options of every command, which the program itself understands
    "--quiet": "show neither tables nor progress, only warnings and errors",
    "--debug": "where something fails, show where in the program",
}
METAVARS = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
NUMBERS = {int: "a whole number", float: "a number"}


def parse(arguments: type[T], words: Sequence[str], program: str) -> T:
    """The options that were typed.

    Args:
        arguments: a dataclass with a text below every field. A field with the metadata
            ``positional`` is given without its name.
        words: what was typed after the name of the command.
        program: the command, for help and errors.

    Raises:
        SystemExit: with 0 after showing help, with 2 after one line about a wrong option.
    """
    parser = parser_of(arguments, program)
    found, rest = parser.parse_known_args(words)
    values = {name: value for name, value in vars(found).items() if _option(name) not in EVERYWHERE}
    if rest:
        parser.error(_not_understood(rest[0], [*map(_option, values), *EVERYWHERE, "--help"]))
    lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return arguments(**values | lists)


def _not_understood(word: str, known: Sequence[str]) -> str:
    if not word.startswith("-"):
        return f"found {word!r}, which belongs to no option"
    hint = did_you_mean(word.partition("=")[0], known) or "; --help lists all"
    return f"found {word!r}, expected an option of this command{hint}"


class _Parser(argparse.ArgumentParser):
    """Complains in one line, as commands do."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(re.sub('^argument (--)?', '', message))}\n")


class _Help(argparse.HelpFormatter):
    """Keeps paragraphs apart, and words with a dash together."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=26)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(text, width, break_on_hyphens=False)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = (" ".join(part.split()) for part in text.split("\n\n"))
        return "\n\n".join("\n".join(self._split_lines(part, width)) for part in paragraphs)


def parser_of(arguments: type[Any], program: str) -> argparse.ArgumentParser:
    """The parser of a dataclass of options."""
    kinds, known = get_type_hints(arguments), {field.name: field for field in fields(arguments)}
    needed = [_usage(f, kinds[f.name]) for f in known.values() if f.default is MISSING]
    about, _, example = (inspect.getdoc(arguments) or "").rpartition("\n\n")
    parser = _Parser(
        program,
        " ".join([program, *needed, "[options]"]),
        about,
        f"example:\n\n{example}",
        formatter_class=_Help,
        allow_abbrev=False,
    )
    groups: dict[str, Any] = {}
    everywhere = parser.add_argument_group("terminal")
    for declares in arguments.__mro__[:-1]:
        title = (inspect.getdoc(declares) or "").rstrip(".").lower()
        if declares is not arguments and title not in groups:
            groups[title] = parser.add_argument_group(title)
        for name, text in _texts(declares).items():
            _add(groups.get(title, parser), known[name], kinds[name], text)
    for option, text in EVERYWHERE.items():
        everywhere.add_argument(option, action="store_true", default=argparse.SUPPRESS, help=text)
    parser.set_defaults(**{f.name: f.default for f in known.values() if f.default is not MISSING})
    return parser


def _usage(field: Field[Any], kind: Any) -> str:
    """What can't be left out, as the line of usage shows it."""
    words = [] if field.metadata.get("positional") else [_option(field.name)]
    several = "..." if get_origin(kind) is tuple else ""
    return " ".join([*words, _metavar(field, kind) + several])


def _texts(declares: type[Any]) -> dict[str, str]:
    """The text below every field that a class declares itself."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(declares))).body
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for field, text in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            assert isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
            found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _add(group: Any, field: Field[Any], kind: Any, text: str) -> None:
    """Add a field to a group of a parser, which brings the defaults itself."""
    required = field.default is MISSING
    options: dict[str, Any] = {"help": (text + _shown(field.default)).replace("%", "%%")}
    if get_origin(kind) in (Union, types.UnionType):  # X | None
        (kind,) = (one for one in get_args(kind) if one is not type(None))
    if get_origin(kind) is tuple:
        kind = get_args(kind)[0]
        options["nargs"] = "+" if required else "*"
    if kind is bool:
        options["action"] = argparse.BooleanOptionalAction if field.default else "store_true"
    else:
        options |= {"type": _reader(kind), "metavar": _metavar(field, kind)}
    if field.metadata.get("positional"):
        count = {} if required else {"nargs": "?"}
        group.add_argument(field.name, **options, **count)
    else:
        group.add_argument(_option(field.name), required=required, **options)


def _metavar(field: Field[Any], kind: Any) -> str:
    if field.metadata.get("positional"):
        return field.name.upper()
    return "|".join(get_args(kind)) if get_origin(kind) is Literal else METAVARS[kind]


def _reader(kind: Any) -> Callable[[str], Any]:
    """From a word to a value of a kind."""

    def read(word: str) -> Any:
        if get_origin(kind) is Literal:
            if word not in get_args(kind):
                raise argparse.ArgumentTypeError(unknown("", word, get_args(kind))[2:])
            return word
        try:
            return kind(word)
        except ValueError:
            message = f"found {word!r}, expected {NUMBERS[kind]}"
            raise argparse.ArgumentTypeError(message) from None

    return read


def _shown(default: Any) -> str:
    """A default as help shows it, where there is something to show."""
    if default is MISSING or default is None or default is False or default == ():
        return ""
    values = default if isinstance(default, tuple) else ("yes",) if default is True else (default,)
    return f" (default: {' '.join(map(str, values))})"
