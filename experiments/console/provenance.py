"""Provenance of results: the command and the versions that made them."""

import platform
import shlex
from collections.abc import Collection
from dataclasses import fields
from typing import Any, get_args, get_type_hints

from tyro.conf import Positional

from experiments.console.options import parsed
from mmwave_env.io.files import Json
from policies.policy_file import versions_of

# options that name the files to write
OUTPUTS = {"json", "episodes_csv", "errors", "consistency", "plot", "out", "map_out", "write"}


def command_line(name: str, args: Any, aside: Collection[str]) -> str:
    """Return the command line that sets the given options.

    Default values are left out, and so are the options ``aside``.
    """
    kinds = get_type_hints(type(args), include_extras=True)
    words = ["mmwave-loc", name]
    options = []
    for field in fields(args):
        value = getattr(args, field.name)
        if value == field.default or field.name in aside:
            continue
        texts = [*map(str, value if isinstance(value, tuple) else (value,))]
        option = field.name.replace("_", "-")
        if Positional in get_args(kinds[field.name]):
            words += texts
        elif isinstance(value, bool):
            options.append(f"--{option}" if value else f"--no-{option}")
        else:
            options += [f"--{option}", *texts]
    return shlex.join([*words, *options])


def provenance(name: str, args: Any) -> Json:
    """Return the command (without output files) and versions, to store with results."""
    return {"command": command_line(name, args, OUTPUTS), "versions": versions()}


def options_from(kind: type[Any], content: Json) -> Any:
    """Return the options of the command that made the results in a file.

    Raises:
        ValueError: the command does not have this kind of options.
        KeyError: the file does not name the command.
    """
    _, name, *words = shlex.split(str(content["command"]))
    for word in words:  # some options end the program, or write a file of the parser's
        if word in ("-h", "--help") or word.startswith("--tyro"):
            raise ValueError(f"command: found {word}, expected options of results")
    return parsed(kind, name, words)


def versions() -> dict[str, str]:
    """Return the versions of this package, Python and the packages that affect the results."""
    return versions_of("gymnasium", "numpy", "numba", "scipy") | {
        "python": platform.python_version()
    }
