"""Parser of a command's options, the fields of a dataclass; it reports a mistake in one line."""

import inspect
import re
import sys
import textwrap
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from typing import TypeVar

T = TypeVar("T")
RULE = re.compile(r"^ +-+ *$", re.MULTILINE)  # line between the parts of tyro's messages


def parse(arguments: type[T], words: Sequence[str], program: str) -> T:
    """Parse words into an instance of a dataclass of options; errors name the ``program``.

    Raises:
        SystemExit: with 0 after showing help, with 2 after one line about a wrong option.
    """
    import tyro

    config = (tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName)
    # tyro joins the lines of a paragraph, except lines that begin with a space.
    about = textwrap.indent(inspect.getdoc(arguments) or "", " ")
    if not {"-h", "--help"}.isdisjoint(words):
        return tyro.cli(arguments, prog=program, description=about, args=words, config=config)
    box = StringIO()
    try:
        with redirect_stdout(box), redirect_stderr(box):
            return tyro.cli(arguments, prog=program, args=words, config=config)
    except SystemExit as end:
        if end.code:
            from mmwave_env.io.lookup import printable

            print(f"{program}: {printable(_message(box.getvalue()))}", file=sys.stderr)
        raise


def _message(box: str) -> str:
    """Return, in one line, tyro's message about a mistake and the option that tyro suggests."""
    parts = [" ".join(part.split()) for part in RULE.split(box)]
    message = parts[1].partition(" Got errors")[0]
    message = re.sub(r"^Missing from .*?: ", "required: ", message).rstrip(".")
    close = re.match(r"Perhaps you meant: (\S+)", parts[2])
    if close:
        return f"{message}; did you mean {close[1]}?"
    return f"{message}; --help lists all options"
