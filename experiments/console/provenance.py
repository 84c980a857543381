"""Provenance of results: the command, its options and the versions that made them."""

import json
import platform
import shlex
from collections.abc import Collection
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from tyro.conf import Positional

from mmwave_env.io.files import Json
from mmwave_env.io.records import require
from policies.policy_file import versions_of

T = TypeVar("T")
# options that name the files to write
OUTPUTS = {"json", "episodes_csv", "errors", "consistency", "plot", "out", "map_out"}


def command_line(name: str, args: Any, aside: Collection[str] = ()) -> str:
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
    """Return the command, its options (except output files) and versions, to store with results."""
    command = command_line(name, args, OUTPUTS)
    return {"command": command, "options": options_of(args), "versions": versions()}


def options_of(args: Any) -> Json:
    """Return options in the form that results files store: no output files, paths as text."""
    options = {name: value for name, value in vars(args).items() if name not in OUTPUTS}
    return json.loads(json.dumps(options, default=str))  # type: ignore[no-any-return]


def options_from(kind: type[T], content: Json) -> T:
    """Return an instance of ``kind`` with the options in a results file and defaults for the rest.

    Raises:
        ValueError: the file has no options, or a value is not of its option's type.
    """
    stored: Any = content.get("options")
    options: dict[str, Any] = {}
    require("options", stored, dict)
    for name, hint in get_type_hints(kind).items():
        if name in stored and name not in OUTPUTS:
            value = stored[name]
            if Path in get_args(hint) and isinstance(value, str):
                value = Path(value)
            require(f"options: {name}", value, hint)
            options[name] = tuple(value) if isinstance(value, list) else value
    return kind(**options)


def versions() -> dict[str, str]:
    """Return the versions of this package, Python and the packages that affect the results."""
    packages = versions_of("gymnasium", "numpy", "numba", "scipy")
    return packages | {"python": platform.python_version()}
